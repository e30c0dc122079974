"""The response of a model to the force of one record, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.periodic import steady_response
from ema_pipeline.mechanics.simulation import DrivenSystem, Sensors, Slopes, march, resolved
from ema_pipeline.observations.record_data import RecordData

DIED_OUT = 10.0
"""Time constants of the slowest mode after which a response is steady."""
_MOST_PERIODS = 50


@dataclass(frozen=True)
class Motion:
    """What a model does in one record.

    Attributes
    ----------
    states : ndarray, (n_samples, 2n + m)
    read : ndarray, (n_samples, n_outputs)
        What calibrated sensors read, SI.
    change : ndarray, (n_samples, n_outputs, p)
        Its derivatives; p = 0 where none were asked for.
    """

    states: NDArray[np.float64]
    read: NDArray[np.float64]
    change: NDArray[np.float64]


def simulated(
    data: RecordData,
    substeps: int,
    slowest_rad_s: float,
    sensors: Sensors,
    system: DrivenSystem,
    begin: NDArray[np.float64],
    slopes: Slopes | None = None,
) -> Motion | None:
    """March a model through a record; None where its motion grows without bound.

    Parameters
    ----------
    data : RecordData
    substeps : int
        Steps per sample.
    slowest_rad_s : float
        Least decay rate of a mode: a periodic record whose steady response is not found by shooting is run through
        until all have died out.
    sensors : Sensors
    system : DrivenSystem
        Its inputs are the forces and their offset.
    begin : ndarray, (2n + m,)
        State at the first sample; of a periodic record, at the start of what comes before.
    slopes : Slopes, optional
    """
    fine = data.fine_force(substeps)
    rate, period = data.record.sample_rate_hz, data.record.n_samples
    system, slopes = resolved(system, 1 / (rate * substeps), slopes)
    found = steady_response(system, rate, substeps, fine, slopes) if data.periodic else None
    before = 0
    if data.periodic and found is None:  # it settles by itself, if at all
        before = int(np.ceil(min(DIED_OUT / slowest_rad_s * rate, _MOST_PERIODS * period)))
        fine = _led_in(data, fine, substeps, before)
    if found is None:
        found = march(system, rate, substeps, fine, begin, slopes)
    if found is None:
        return None
    kept = slice(before, before + period)
    states, change = found[0][kept], np.ascontiguousarray(found[1][kept])
    force = fine[:: 2 * substeps][kept]
    read, slope = sensors.read(system, states, force, change, slopes)
    return Motion(states, read, slope)


def _led_in(data: RecordData, fine: NDArray[np.float64], substeps: int, before: int) -> NDArray[np.float64]:
    """Force of one period with what came before it."""
    known: dict[tuple[int, int], NDArray[np.float64]] = data.__dict__.setdefault("_led", {})
    if (substeps, before) not in known:
        points = len(fine) - 1
        at = np.arange(-before * 2 * substeps, points + 1) % points
        known[substeps, before] = np.ascontiguousarray(fine[at])
    return known[substeps, before]
