"""The response of a model to the force of one record, with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.driven_system import DrivenSystem, Slopes, resolved
from ema_pipeline.mechanics.periodic import steady_response
from ema_pipeline.mechanics.simulation import Sensors, march_windows
from ema_pipeline.observations.record_data import RecordData

DIED_OUT = 10.0
"""Time constants of the slowest mode after which a response is steady."""
_MOST_PERIODS = 50


@dataclass(frozen=True)
class Motion:
    """What a model does in one record.

    Attributes
    ----------
    states : ndarray, (n_windows, n_samples, 2n + m)
    read : ndarray, (n_windows, n_samples, n_outputs)
        What calibrated sensors read, SI.
    change : ndarray, (n_windows, n_samples, n_outputs, p)
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
    begin : ndarray, (n_windows, 2n + m)
        State at the first sample; of a periodic record, at the start of what comes before.
    slopes : Slopes, optional
        Its derivatives of the first state are those of every window, (n_windows, 2n + m, p).
    """
    fine = data.fine_force(substeps)
    rate, samples = data.record.sample_rate_hz, data.samples
    system, slopes = resolved(system, 1 / (rate * substeps), slopes)
    found, before = None, 0
    if data.periodic:
        steady = steady_response(system, rate, substeps, fine[0], slopes)
        if steady is not None:
            found = steady[0][None], steady[1][None]
        else:  # it settles by itself, if at all
            before = int(np.ceil(min(DIED_OUT / slowest_rad_s * rate, _MOST_PERIODS * samples)))
            fine = _led_in(data, fine, substeps, before)
            slopes = None if slopes is None else replace(slopes, begin=slopes.begin[None])
    if found is None:
        found = march_windows(system, rate, substeps, fine, begin, slopes)
    if found is None:
        return None
    kept = slice(before, before + samples)
    states, change = found[0][:, kept], found[1][:, kept]
    force = fine[:, :: 2 * substeps][:, kept]
    shape = states.shape[:2]
    read, slope = sensors.read(system, _joined(states), _joined(force), _joined(change), slopes)
    return Motion(states, read.reshape(*shape, -1), slope.reshape(*shape, *slope.shape[1:]))


def _joined(windows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n_windows, n_samples, ...) to (n_windows·n_samples, ...)."""
    count = windows.shape[0] * windows.shape[1]
    return np.ascontiguousarray(windows).reshape(count, *windows.shape[2:])


def _led_in(data: RecordData, fine: NDArray[np.float64], substeps: int, before: int) -> NDArray[np.float64]:
    """Force of one period with what came before it."""
    known: dict[tuple[int, int], NDArray[np.float64]] = data.__dict__.setdefault("_led", {})
    if (substeps, before) not in known:
        points = fine.shape[1] - 1
        at = np.arange(-before * 2 * substeps, points + 1) % points
        known[substeps, before] = np.ascontiguousarray(fine[:, at])
    return known[substeps, before]
