"""Ways down to an optimum of one fit: annealed, widened, or straight; and what may be believed of where they end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.fit.latent import LatentObjective
from ema_pipeline.fit.solve import FitProblem, Mixture, Optimum, descend, refine

_TAU_RUNGS = (0.1, 0.02, 0.004)
_STALE = 1.0
_WIDE, _WIDENED = 3e-2, (3e-3, 5e-4)
"""Relative errors of frequency that widened uncertainties allow, whatever the noise level."""
_NARROW = 2e-4
_FINEST = 1e-6
_MOST_KEPT = 6


def straight(problem: FitProblem, x: NDArray[np.float64]) -> Optimum:
    """Refine as it stands; settle too where modes are lost on the way."""
    found = honest(problem, refine(problem, x))
    if np.all(found.inlier > 0.5):
        return found
    return min((found, honest(problem, settle(problem, x))), key=lambda o: o.objective)


def settle(problem: FitProblem, x: NDArray[np.float64]) -> Optimum:
    """Refine, uncertainties at first widened, so that modes which are off by some do not let go at once.

    Where modes were lost all the same, a parameter that only they know may be off by its tolerance: once more, then,
    with uncertainties wide enough for that.
    """
    found = _narrowed(problem, x, _WIDENED)
    if np.all(found.inlier > 0.5):
        return found
    again = _narrowed(problem, found.x, (_WIDE, *_WIDENED))
    return min((found, again), key=lambda o: o.objective)


def insisting(problem: FitProblem, x: NDArray[np.float64]) -> Optimum:
    """Narrowed slowly with no mode let go: one that is lost again in the end has no place in the model."""
    for error in (*_WIDENED, _NARROW):
        mixture = _allowing(problem, error).trusting()
        x = descend(problem.exact(problem.assignments(x), alone=0.0), problem.space, x, mixture, 6).x
    return refine(problem, x)


def _narrowed(
    problem: FitProblem,
    x: NDArray[np.float64],
    errors: Sequence[float],
    held: Sequence[NDArray[np.int64]] | None = None,
) -> Optimum:
    """Refined after steps with uncertainties less and less widened, in `held` pairs or those of each point."""
    for error in errors:
        pairs = problem.assignments(x) if held is None else held
        x = descend(problem.exact(pairs), problem.space, x, _allowing(problem, error), 4).x
    return refine(problem, x)


def _allowing(problem: FitProblem, error: float) -> Mixture:
    """All uncertainties widened by what a relative error of frequency needs."""
    return problem.mixture(max(error / max(problem.settings.frequency_floor, _FINEST), 1.0))


def first_steps(problem: FitProblem, x: NDArray[np.float64]) -> Optimum:
    """A few steps, enough to tell starts apart."""
    found = None
    for mixture in (_allowing(problem, _WIDENED[0]), problem.mixture()):
        pairs = problem.assignments(x)
        found = descend(problem.exact(pairs), problem.space, x, mixture, 3)
        x = found.x
    assert found is not None
    return found


def descend_rungs(problem: FitProblem, x: NDArray[np.float64]) -> Optimum:
    """Latent shapes, annealed: no mode is given up on the way."""
    mixture = problem.mixture()
    found = None
    for tau in _TAU_RUNGS:
        found = descend(LatentObjective(problem.evidence, tau), problem.space, x, mixture, 6)
        x = found.x
    assert found is not None
    return found


def keeping_one(problem: FitProblem, lost: NDArray[np.bool_]) -> list[Optimum]:
    """Optima that hold on to one of the modes which a fit has given up, one after the other.

    Modes that the model cannot have at their distance (a pair that is split) let go together, and of the parameter
    that only they know: it is then anywhere, and what would explain them starts from nowhere.

    Parameters
    ----------
    problem : FitProblem
    lost : ndarray of bool, (R,)
        Modes given up, configurations one after the other.
    """
    start = descend_rungs(problem, problem.space.point()).x
    pairs = problem.assignments(start)
    ends = np.cumsum([p.size for p in pairs])[:-1]
    every = np.concatenate(pairs)
    found = []
    for kept in np.flatnonzero(lost & (every >= 0))[:_MOST_KEPT]:
        alone = np.where(lost, -1, every)
        alone[kept] = every[kept]
        found.append(_narrowed(problem, start, (_WIDE, *_WIDENED), np.split(alone, ends)))
    return found


def honest(problem: FitProblem, found: Optimum) -> Optimum:
    """The optimum with the pairs that its own parameters give.

    A fit with held pairs may drive a mode that it is paired with out of the sensors' sight, where mixed with its
    neighbours it fits anything. Paired anew there, the measured mode has lost its partner and shows it.
    """
    objective = problem.exact(problem.assignments(found.x))
    costs = objective.costs(found.x)
    mixture = problem.mixture()
    prior = problem.space.has_prior
    value = float(np.sum(mixture.robust(costs)) + np.sum(found.x[prior] ** 2))
    if value <= found.objective + _STALE:
        return found
    return replace(found, objective=value, costs=costs, inlier=mixture.inlier(costs))


def best_distinct(found: Sequence[Optimum], count: int) -> list[NDArray[np.float64]]:
    """Points of the lowest optima that differ by more than a tolerance somewhere."""
    kept: list[NDArray[np.float64]] = []
    for o in sorted(found, key=lambda o: o.objective):
        if all(np.max(np.abs(o.x - k)) > 0.5 for k in kept):
            kept.append(o.x)
        if len(kept) == count:
            break
    return kept
