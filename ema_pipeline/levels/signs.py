"""Other signs of a nonlinearity: FRFs that differ between levels, coherence that dips, circles that are none.

They support what the test on single hits decides, and show where; they decide nothing themselves, since hits that
miss their spot give the same signs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.types import ForceLevel
from ema_pipeline.modal.circle.compare import distortion
from ema_pipeline.modal.circle.modes import circle_fits
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.types import ModalModel, Mode

Real = NDArray[np.float64]

HOMOGENEOUS = 2.0
"""Root-mean-square difference of FRFs between two levels in their standard deviations; 1 for equal ones."""

HALF_WIDTHS = 2.0
"""Lines about a mode that are looked at, in half-power half-widths."""

STRONG = 0.3
"""FRFs in which a mode reaches this share of its largest response tell of it."""

DIP = 4.0
"""Lost coherence over all levels, over that within the hardest one, that is a dip."""

LEAST_DIP = 1e-3

ROUND = 0.05
"""Misfit of a Nyquist circle over its radius; three times the misfit at the softest level is allowed anyway."""

SMOOTH = 0.3
"""Correlation of the misfit from line to line above which it is no noise."""


def signs(levels: Sequence[ForceLevel], frfs: FrfSet, modal: ModalModel) -> tuple[CheckResult, ...]:
    """Signs at every mode, all with consequence "warn".

    Parameters
    ----------
    levels : sequence of ForceLevel
        Two or more.
    frfs : FrfSet
        Of all hits together.
    modal : ModalModel
        Modes to look at.

    Returns
    -------
    tuple of CheckResult
        `channel` names the mode.
    """
    found: list[CheckResult] = []
    soft, hard = (circle_fits(level.frfs, modal, CircleSettings()) for level in (levels[0], levels[-1]))
    for mode, soft_circles, hard_circles in zip(modal.modes, soft, hard, strict=True):
        found += _homogeneity(levels[0].frfs, levels[-1].frfs, mode)
        found += _coherence(levels[-1].frfs, frfs, mode)
        if hard_circles:
            correlation, size = distortion(hard_circles)
            limit = max(ROUND, 3 * distortion(soft_circles)[1])
            bad = size > limit and correlation > SMOOTH
            message = f"leaves its circle by {100 * size:.2g} % of the radius at {levels[-1].label}"
            found.append(_verdict("Nyquist circle", size, limit, not bad, mode, message))
    return tuple(found)


def _lines(frfs: FrfSet, mode: Mode) -> slice:
    half = HALF_WIDTHS * max(mode.frequency_hz * mode.damping_ratio, float(frfs.frequency_hz[1]))
    first, stop = np.searchsorted(frfs.frequency_hz, [mode.frequency_hz - half, mode.frequency_hz + half])
    return slice(max(int(first), 1), max(int(stop), int(first) + 1))


def _homogeneity(soft: FrfSet, hard: FrfSet, mode: Mode) -> list[CheckResult]:
    """Difference of the FRFs of two levels in units of its own standard deviation."""
    lines = _lines(soft, mode)
    shared_out = [d for d in soft.outputs if d in hard.outputs]
    shared_in = [d for d in soft.inputs if d in hard.inputs]
    if not shared_out or not shared_in:
        return []

    def cut(values: NDArray[Any], frfs: FrfSet) -> NDArray[Any]:
        outputs = [frfs.outputs.index(d) for d in shared_out]
        return values[np.ix_(outputs, [frfs.inputs.index(d) for d in shared_in])][..., lines]

    difference = np.abs(cut(soft.frf, soft) - cut(hard.frf, hard)) ** 2
    variance = cut(soft.variance, soft) + cut(hard.variance, hard)
    size = np.sum(np.abs(cut(hard.frf, hard)) ** 2, axis=-1)
    strong = size > STRONG**2 * np.nanmax(size, axis=1, keepdims=True, initial=0.0)
    use = strong[..., None] & np.isfinite(difference) & np.isfinite(variance) & (variance > 0)
    if not use.any():
        return []
    value = float(np.sqrt(np.mean(difference[use] / variance[use])))
    message = f"FRFs of the softest and the hardest level differ by {value:.3g} standard deviations"
    return [_verdict("FRF homogeneity", value, HOMOGENEOUS, value <= HOMOGENEOUS, mode, message)]


def _coherence(hard: FrfSet, everything: FrfSet, mode: Mode) -> list[CheckResult]:
    """Coherence lost over all levels against that within the hardest level."""
    lost_hard, lost = _lost(hard, mode), _lost(everything, mode)
    if not (np.isfinite(lost_hard) and np.isfinite(lost)):
        return []
    limit = DIP * lost_hard + LEAST_DIP
    message = f"coherence over all levels dips to {1 - lost:.4g} at the resonance, {1 - lost_hard:.4g} within a level"
    return [_verdict("coherence dip", lost, limit, lost <= limit, mode, message)]


def _lost(frfs: FrfSet, mode: Mode) -> float:
    """1 - γ² about a mode, FRFs and lines weighted by their power."""
    lines = _lines(frfs, mode)
    power, coherence = np.abs(frfs.frf[..., lines]) ** 2, frfs.coherence[..., lines]
    known = np.isfinite(coherence) & np.isfinite(power) & (frfs.hits[..., None] > 1)
    if not known.any():
        return float("nan")
    return float(np.sum(power[known] * (1 - coherence[known])) / max(float(np.sum(power[known])), 1e-300))


def _verdict(check: str, value: float, limit: float, passes: bool, mode: Mode, message: str) -> CheckResult:
    where = f"{mode.frequency_hz:.5g} Hz"
    return CheckResult(
        check=check,
        value=value,
        limit=limit,
        unit="1",
        passes=passes,
        clause="",
        consequence="warn",
        channel=where,
        message="" if passes else f"{where}: {message}",
    )
