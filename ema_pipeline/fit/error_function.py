"""The error function of natural frequencies over one stiffness, and the stepwise route built on it.

ε = Σ ((ω_measured - ω_model)/ω_model)², each measured frequency held against the nearest model frequency.

References
----------
K. A. Olanipekun, "Estimation of a planetary gear mesh stiffness: an approach based on minimising error
function", Eq. 10 and Figs. 5 and 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.pairing import RIGID_HZ
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import ErrorSweep, StepwiseEstimate
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.types import Rig

LOW, HIGH = 1e6, 1e9


def frequency_error(measured_hz: NDArray[np.float64], model_hz: NDArray[np.float64]) -> float:
    """ε of measured frequencies against the nearest model frequencies; rigid-body modes take no part.

    Parameters
    ----------
    measured_hz : ndarray, (n_measured,)
    model_hz : ndarray, (n_model,)

    Raises
    ------
    EmaError
        If the model has no elastic mode.
    """
    elastic = model_hz[model_hz > RIGID_HZ]
    if elastic.size == 0:
        raise EmaError("the model has no mode above 0 Hz to compare frequencies with: check its stiffnesses")
    nearest = elastic[np.argmin(np.abs(measured_hz[:, None] - elastic[None, :]), axis=1)]
    return float(np.sum(((measured_hz - nearest) / nearest) ** 2))


def error_sweep(
    rig: Rig,
    configuration: str,
    parameter: str,
    measured_hz: Sequence[float] | NDArray[np.float64],
    mode_count: int,
    settings: FitSettings,
    values: Mapping[str, float] | None = None,
) -> ErrorSweep:
    """ε over one stiffness, and whether its minimum means anything.

    Parameters
    ----------
    rig : Rig
    configuration, parameter : str
    measured_hz : sequence of float
        Measured frequencies; the lowest `mode_count` are used.
    mode_count : int
    settings : FitSettings
    values : mapping, optional
        Values of other parameters; nominal where left out.

    Notes
    -----
    The sweep runs over the parameter's bounds, over 1e6…1e9 N/m where it has none. The minimum is identified
    where ε is at least `flat_depth` deep, lies inside the sweep, and rises by more than that on both sides.
    """
    if parameter not in rig.parameters:
        raise EmaError(f"rig '{rig.name}' has no parameter '{parameter}' to sweep")
    p = rig.parameters[parameter]
    low = p.minimum if p.minimum > 0 else LOW
    high = p.maximum if np.isfinite(p.maximum) and p.maximum > low else max(HIGH, 10 * low)
    used = np.sort(np.asarray(measured_hz, dtype=float))[:mode_count]
    stiffness = np.geomspace(low, high, settings.sweep_points)
    error = np.array(
        [frequency_error(used, f) for f in _swept(rig, configuration, parameter, stiffness, values or {})]
    )
    at = int(np.argmin(error))
    least = max(float(error[at]), 1e-300)
    depth = float((np.median(error) - least) / least)
    left = float((error[: at + 1].max() - least) / least)
    right = float((error[at:].max() - least) / least)
    spread = float((error.max() - error.min()) / least)
    identified, note = _judge(depth, left, right, spread, at in (0, error.size - 1), settings.flat_depth)
    return ErrorSweep(
        parameter=parameter,
        configuration=configuration,
        mode_count=int(used.size),
        values=stiffness,
        error=error,
        minimum=float(stiffness[at]),
        relative_depth=depth,
        identified=identified,
        note=note,
    )


def _swept(
    rig: Rig, configuration: str, parameter: str, stiffness: NDArray[np.float64], values: Mapping[str, float]
) -> Iterator[NDArray[np.float64]]:
    """The model's frequencies, Hz, at every stiffness; matrices that are linear in it are interpolated."""

    def system(k: float) -> LinearSystem:
        return rig.system(configuration, {**values, parameter: float(k)})

    low, high = stiffness[0], stiffness[-1]
    first, last, middle = system(low), system(high), system(stiffness[stiffness.size // 2])
    slope = (last.stiffness - first.stiffness) / (high - low)
    expected = first.stiffness + slope * (stiffness[stiffness.size // 2] - low)
    alike = np.array_equal(first.mass, middle.mass) and np.array_equal(first.mass, last.mass)
    linear = alike and np.allclose(
        expected, middle.stiffness, rtol=1e-9, atol=1e-12 * np.abs(last.stiffness).max()
    )
    for k in stiffness:
        at = replace(first, stiffness=first.stiffness + slope * (k - low)) if linear else system(float(k))
        yield normal_modes(at)[0]


def _judge(
    depth: float, left: float, right: float, spread: float, at_end: bool, flat: float
) -> tuple[bool, str]:
    if spread < flat or depth < flat / 2:
        return False, (
            f"flat: ε changes by {100 * spread:.2g} % over the whole sweep, so its minimum determines nothing"
        )
    if at_end:
        return False, "ε is least at the end of the sweep: no minimum inside"
    if min(left, right) < flat:
        side = "below" if left < right else "above"
        return False, f"ε rises by only {100 * min(left, right):.2g} % {side} its minimum: open on that side"
    return True, f"ε rises by {100 * left:.3g} % below and {100 * right:.3g} % above its minimum"


def mode_counts(available: int) -> tuple[int, ...]:
    """Numbers of modes to sweep with: three and four, as the method's source does, and all."""
    return tuple(sorted({n for n in (3, 4) if n <= available} | ({available} if available else set())))


def stepwise(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: FitSettings,
    mode_count: int | None = None,
) -> StepwiseEstimate:
    """The stiffnesses of the rig's steps, each with those of the earlier steps known, and their average.

    All measured modes are used, or the lowest `mode_count`.
    """
    sound = True
    notes = []
    values: dict[str, float] = {}
    known: dict[str, float] = {}
    for configuration, parameter in rig.stiffness_steps:
        modes, label = measured.get(configuration), parameter.replace("_", " ")
        values[parameter] = float("nan")
        if modes is None or not len(modes):
            notes.append(f"{label}: {configuration} was not measured")
            continue
        count = len(modes) if mode_count is None else mode_count
        sweep = error_sweep(rig, configuration, parameter, modes.frequency_hz, count, settings, known)
        values[parameter] = known[parameter] = sweep.minimum
        sound &= sweep.identified
        if not sweep.identified:
            notes.append(f"{label}: {sweep.note}")
    average = sum(values.values()) / len(values) if sound else float("nan")
    return StepwiseEstimate(values, average, "; ".join(notes))
