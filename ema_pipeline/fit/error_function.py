"""The error function of natural frequencies over one stiffness, and the two-step route built on it.

ε = Σ ((ω_measured - ω_model)/ω_model)², each measured frequency held against the nearest model frequency.

References
----------
K. A. Olanipekun, "Estimation of a planetary gear mesh stiffness: an approach based on minimising error
function",
Eq. 10 and Figs. 5 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.pairing import RIGID_HZ
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import ErrorSweep, TwoStep
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.rigs.types import Rig

SUN_PLANET, RING_PLANET = "sun_planet_mesh_stiffness", "ring_planet_mesh_stiffness"
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
        [
            frequency_error(
                used, normal_modes(rig.system(configuration, {**(values or {}), parameter: float(k)}))[0]
            )
            for k in stiffness
        ]
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


def two_step(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: FitSettings,
    mode_count: int | None = None,
) -> TwoStep:
    """Sun-planet stiffness from ``no_ring``, with it ring-planet from ``with_ring``, then their average.

    All measured modes are used, or the lowest `mode_count`. Values are NaN where the configuration was not
    measured; the average is NaN unless both steps determine their stiffness, and the note says why they do
    not.
    """
    sun = ring = float("nan")
    sound = True
    notes = []
    values: dict[str, float] = {}
    steps = (("no_ring", SUN_PLANET, "sun-planet"), ("with_ring", RING_PLANET, "ring-planet"))
    for configuration, parameter, label in steps:
        modes = measured.get(configuration)
        if modes is None or not len(modes):
            notes.append(f"{label}: {configuration} was not measured")
            continue
        count = len(modes) if mode_count is None else mode_count
        sweep = error_sweep(rig, configuration, parameter, modes.frequency_hz, count, settings, values)
        values[parameter] = sweep.minimum
        sound &= sweep.identified
        if not sweep.identified:
            notes.append(f"{label}: {sweep.note}")
        if parameter == SUN_PLANET:
            sun = sweep.minimum
        else:
            ring = sweep.minimum
    both = sound and np.isfinite(sun) and np.isfinite(ring)
    return TwoStep(sun, ring, 0.5 * (sun + ring) if both else float("nan"), "; ".join(notes))
