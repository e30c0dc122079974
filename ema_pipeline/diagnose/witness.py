"""A second witness: does an effect also mend the FRFs, from which the modes were read but which were not fitted?

The fit sees modes: frequencies, damping ratios and shapes. An FRF holds more: scale (modal masses), phase, residual
terms of all other modes, and what lies between the modes. So every model is also held against the FRFs themselves,
in bands around the measured modes, where they are known best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.compare import windowed_accelerance
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.types import Rig

_HALF_WIDTH = 4.0
"""Half width of a band in half-power half-widths ζf: beyond, other modes count for as much."""
_LINES = 15
_FLOOR = 0.05
"""Relative: sensors and hammer 3 % (ISO 16063-21), damping of the model 3 %, its frequencies 1e-4 at ζ = 0.3 %."""
_BACKGROUND = 0.01
_DAMPING = 0.01
_WORSE = 1.05
_FAR_WORSE = 1.25
_FAR_OFF = 2.5
_FOLLOWS = 0.7


@dataclass(frozen=True)
class FrfLines:
    """FRF lines of one configuration around its modes.

    Attributes
    ----------
    configuration : str
    frfs : FrfSet
        At these lines only.
    measured : complex ndarray, (n_outputs, n_inputs, n_lines)
        Accelerance, NaN where not measured.
    variance : ndarray, (n_outputs, n_inputs, n_lines)
        Of the complex difference from a model: scatter of the hits and what any comparison leaves.
    """

    configuration: str
    frfs: FrfSet
    measured: NDArray[np.complex128]
    variance: NDArray[np.float64]


@dataclass(frozen=True)
class FrfError:
    """How far a model's FRFs are from the measured ones.

    Attributes
    ----------
    error : float
        Root-mean-square of (measured - model)/standard uncertainty; NaN where there are no FRFs.
    by_impact : dict of str to float
        The same for each impact point, ``configuration: point``.
    """

    error: float
    by_impact: dict[str, float]


def frf_lines(frfs: Mapping[str, FrfSet], measured: Mapping[str, MeasuredModes]) -> tuple[FrfLines, ...]:
    """The lines around the measured modes, with uncertainties.

    Parameters
    ----------
    frfs : mapping of configuration to FrfSet
    measured : mapping of configuration to MeasuredModes
        Configurations without modes are passed over.
    """
    found = []
    for configuration, m in measured.items():
        if configuration not in frfs or not len(m):
            continue
        whole = frfs[configuration]
        at = _near_modes(whole, m)
        if at.size == 0:
            continue
        picked = replace(
            whole,
            frequency_hz=whole.frequency_hz[at],
            frf=whole.frf[..., at],
            coherence=whole.coherence[..., at],
            variance=whole.variance[..., at],
        )
        h = picked.accelerance()
        size = np.abs(h) ** 2
        factor = size / np.maximum(np.abs(picked.frf) ** 2, 1e-300)
        # the scatter of two or three hits is itself too uncertain to be used line by line
        scatter = np.mean(np.nan_to_num(picked.variance * factor), axis=2, keepdims=True)
        level = np.nanmean(size, axis=0, keepdims=True)
        variance = scatter + _FLOOR**2 * size + _BACKGROUND**2 * level
        found.append(FrfLines(configuration, picked, h, variance))
    return tuple(found)


def _near_modes(frfs: FrfSet, m: MeasuredModes) -> NDArray[np.int64]:
    f = frfs.frequency_hz
    low, high = frfs.band_hz
    lines: set[int] = set()
    for r in range(len(m)):
        damping = m.damping_ratio[r] if np.isfinite(m.damping_ratio[r]) else _DAMPING
        step = float(f[1] - f[0])
        half = max(_HALF_WIDTH * float(damping) * float(m.frequency_hz[r]), 2 * step)
        inside = np.flatnonzero((np.abs(f - m.frequency_hz[r]) <= half) & (f > 0) & (f >= low) & (f <= high))
        if inside.size > _LINES:
            inside = inside[np.linspace(0, inside.size - 1, _LINES).round().astype(int)]
        lines.update(int(i) for i in inside)
    return np.array(sorted(lines), dtype=np.int64)


def frf_error(rig: Rig, values: Mapping[str, float], lines: Sequence[FrfLines]) -> FrfError:
    """A model's FRFs against the measured ones.

    An FRF in volts has no scale of its own: one common factor is then fitted to each impact point.
    """
    squares, counts = 0.0, 0
    by_impact: dict[str, float] = {}
    for one in lines:
        used = {n: v for n, v in values.items() if n in rig.parameters}
        model = windowed_accelerance(rig.system(one.configuration, used), one.frfs)
        known = np.isfinite(one.measured)
        h = np.where(known, one.measured, 0.0)
        if not one.frfs.force_calibrated:
            overlap = np.sum(np.abs(h * model.conj()), axis=(0, 2))
            model = (
                model
                * (overlap / np.maximum(np.sum(np.abs(model) ** 2 * known, axis=(0, 2)), 1e-300))[
                    None, :, None
                ]
            )
        z2 = np.where(known, np.abs(h - model) ** 2 / np.maximum(one.variance, 1e-300), 0.0)
        for i, point in enumerate(one.frfs.inputs):
            count = int(np.sum(known[:, i]))
            if count:
                total = float(np.sum(z2[:, i]))
                by_impact[f"{one.configuration}: {point.point}"] = float(np.sqrt(total / count))
                squares, counts = squares + total, counts + count
    return FrfError(float(np.sqrt(squares / counts)) if counts else float("nan"), by_impact)


@dataclass(frozen=True)
class Witness:
    """FRFs that models are held against; says nothing where there are none.

    Attributes
    ----------
    case : Case
    lines : tuple of FrfLines
    """

    case: Case
    lines: tuple[FrfLines, ...] = ()

    def error(self, fitted: Fitted) -> FrfError:
        """FRF error of a fitted hypothesis."""
        if not self.lines:
            return FrfError(float("nan"), {})
        return frf_error(self.case.rig_of(fitted.hypothesis), fitted.values, self.lines)

    def rejects(self, base: FrfError, fitted: Fitted, explains_modes: bool) -> bool:
        """True where the FRFs contradict a hypothesis, or it explains all modes and leaves the FRFs as wrong as
        they were: then its added freedom met the frequencies by other means than the rig does."""
        found = self.error(fitted)
        unmoved = found.error > max(_FAR_OFF, _FOLLOWS * base.error)
        return contradicts(base, found) or (explains_modes and unmoved)

    def prefers(self, first: Fitted, other: Fitted) -> bool:
        """True where the FRFs speak clearly for one of two hypotheses that the modes do not tell apart."""
        return contradicts(self.error(first), self.error(other), _FAR_WORSE)


def contradicts(before: FrfError, after: FrfError, worse: float = _WORSE) -> bool:
    """True where a model's FRFs are further off than another's, overall by a factor and at most impact points.

    What lies within the uncertainty is no contradiction.
    """
    if not worse * max(before.error, 1.0) < after.error:
        return False
    better, shared = better_share(before, after)
    return better < 0.5 * shared


def better_share(before: FrfError, after: FrfError) -> tuple[int, int]:
    """Impact points at which a model brings the FRFs nearer than another, and how many there are."""
    shared = before.by_impact.keys() & after.by_impact.keys()
    return sum(after.by_impact[k] < before.by_impact[k] for k in shared), len(shared)
