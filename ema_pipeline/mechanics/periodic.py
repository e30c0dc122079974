"""Steady response to a periodic force by shooting: the state that comes back after one period, and its derivatives.

A lightly damped structure takes dozens of periods to settle. Newton steps on the state at the start of the period take
two or three, whatever the damping.

References
----------
A. H. Nayfeh, B. Balachandran, *Applied Nonlinear Dynamics* (1995), section 6.5; M. Peeters, R. Viguie, G. Serandour,
G. Kerschen, J.-C. Golinval, Nonlinear normal modes, part II, *Mechanical Systems and Signal Processing* 23 (2009).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.driven_system import WITH_MEMORY, DrivenSystem, Slopes
from ema_pipeline.mechanics.simulation import march

_ROUNDS = 12
"""Periods or Newton steps after which the response is left to settle by itself."""
_CLOSED = 1e-7
"""Gap after one period, over the largest motion, at which the response counts as periodic."""
_STABLE = 1 - 1e-6
"""Largest multiplier of a response that a structure settles to; 1 where a memory never fades."""


def steady_response(
    system: DrivenSystem,
    sample_rate_hz: float,
    substeps: int,
    force: NDArray[np.float64],
    slopes: Slopes | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """States over one period of the steady response, and their derivatives.

    Parameters
    ----------
    system : DrivenSystem
    sample_rate_hz : float
    substeps : int
        Steps per sample.
    force : ndarray, (2·substeps·n_samples + 1, n_inputs)
        One period, its first value once more at its end, N.
    slopes : Slopes, optional
        Of p parameters; what they say of the first state is not used.

    Returns
    -------
    states : ndarray, (n_samples + 1, 2n + m)
    derivatives : ndarray, (n_samples + 1, 2n + m, p)
        (n_samples + 1, 2n + m, 0) without slopes. None where no stable periodic response is found from rest.
    """
    free = _changing(system)
    found = march(system, sample_rate_hz, substeps, force, np.zeros(system.size))
    for _ in range(_ROUNDS):
        if found is None or _gap(found[0]) < _CLOSED:
            break
        begin = found[0][-1].copy()
        varied = march(
            system, sample_rate_hz, substeps, force, begin, _by_begin(Slopes.none(system, 0), free)
        )
        if varied is None:
            return None
        step = _returning(varied[1][-1, free], varied[0][-1, free] - begin[free])
        begin[free] += step
        found = march(system, sample_rate_hz, substeps, force, begin)
        if found is None or _gap(found[0]) > _gap(
            varied[0]
        ):  # too far for Newton: let it settle for a period
            found = varied
    if found is None or not _gap(found[0]) < _CLOSED:
        return None
    p = 0 if slopes is None else slopes.begin.shape[1]
    given = slopes or Slopes.none(system, 0)
    varied = march(system, sample_rate_hz, substeps, force, found[0][0], _by_begin(given, free))
    if varied is None or not _settles(varied[1][-1, free, p:]):
        return None
    by_parameters, by_begin = varied[1][..., :p], varied[1][..., p:]
    return varied[0], by_parameters + by_begin @ _returning(by_begin[-1, free], by_parameters[-1, free])


def _changing(system: DrivenSystem) -> NDArray[np.intp]:
    """States that a motion changes: all but the memories of elements that have none."""
    memory = np.isin(system.kinds, WITH_MEMORY)
    return np.flatnonzero(np.concatenate([np.ones(system.size - len(memory), dtype=bool), memory]))


def _returning(monodromy: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the first state has to move by so that a change over the period is undone."""
    return np.asarray(np.linalg.lstsq(np.eye(len(monodromy)) - monodromy, change, rcond=None)[0])


def _by_begin(slopes: Slopes, free: NDArray[np.intp]) -> Slopes:
    """Slopes whose first state depends on nothing but itself, with derivatives by its free parts added."""
    size = len(slopes.begin)
    arrays = (slopes.stiffness, slopes.damping, slopes.inputs, slopes.push, slopes.numbers)
    begin = np.hstack([np.zeros(slopes.begin.shape), np.eye(size)[:, free]])
    more = [np.concatenate([a, np.zeros((*a.shape[:-1], len(free)))], axis=-1) for a in arrays]
    return Slopes(more[0], more[1], more[2], more[3], more[4], begin)


def _settles(monodromy: NDArray[np.float64]) -> bool:
    """True for the derivative of the last state by the first of a response that disturbances die out of."""
    return bool(np.all(np.isfinite(monodromy)) and np.max(np.abs(np.linalg.eigvals(monodromy))) < _STABLE)


def _gap(states: NDArray[np.float64]) -> float:
    """Largest change of a state over one period, over its largest value."""
    return float(np.max(np.abs(states[-1] - states[0]) / np.maximum(np.max(np.abs(states), axis=0), 1e-300)))
