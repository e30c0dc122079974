"""Single unknowns as they are known whatever all others are: mean and 1 σ of their own distribution."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.factor import lower_factor
from ema_pipeline.inference.maximise import descend
from ema_pipeline.inference.posterior import LARGE, Posterior
from ema_pipeline.inference.problem import Problem

_STEPS = 8
_FURTHEST = 8
"""Values on either side of the maximum, in standard deviations, at which the density is calculated at most."""
_LOW = 7.0
"""Logarithm of the density, below its largest, at which it counts as nothing."""
_STEEP = 3.5
"""Standard deviations within which a density that falls to nothing is looked at in finer steps, in σ, `_FINE`."""
_FINE = 0.5
_FEWEST = 4
_LOWER = 2.0
"""Fall of the cost on the way to another value from which a fit was not at its maximum."""
_MOST_AGAIN = 3
_AGAIN_STEPS = 30


def averaged_over_others(problem: Problem, found: Posterior, names: Iterable[str]) -> Posterior:
    """A posterior whose values and standard deviations of some unknowns are those of their own distributions.

    Where the precision of others depends on an unknown, its value at the joint maximum lies to one side of its mean:
    damping ratios that scatter in their logarithms tell the less of a damper the more it is said to damp, and the
    largest density had dampers 2 to 14 % too small. Residuals and derivatives stay those of the maximum.

    The prior of a size of an effect counts up to two of its σ as everywhere else, and with an even slope from there.

    Where another value of one leads to a far larger density, the fit had stopped before its maximum (at a point where
    modes change places, say): it is begun again from there.

    Parameters
    ----------
    problem : Problem
    found : Posterior
        At its maximum.
    names : iterable of str

    References
    ----------
    L. Tierney, J. B. Kadane, Accurate approximations for posterior moments and marginal densities, J. Am. Stat. Assoc.
    81 (1986) 82-86.
    """
    return _averaged(problem, found, [found.unknowns.index[name] for name in names], _MOST_AGAIN)


def _averaged(problem: Problem, found: Posterior, places: Sequence[int], again: int) -> Posterior:
    x, widths = found.x.copy(), np.ones(len(found.x))
    for i in places:
        at, log_density, best = _profile(problem, found, i)
        if again and best.cost < found.cost - _LOWER:
            further = descend(problem, found.scatters, best.x, steps=_AGAIN_STEPS)
            return _averaged(problem, further, places, again - 1)
        if len(at) >= _FEWEST:
            weight = np.exp(log_density - np.max(log_density))
            mean = float(weight @ at / np.sum(weight))
            widths[i] = np.sqrt(weight @ (at - mean) ** 2 / np.sum(weight))
            x[i] += mean * found.std[i]
    return replace(found, x=found.unknowns.clipped(x), widths=widths)


def _profile(
    problem: Problem, found: Posterior, i: int, spacing: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], Posterior]:
    """Places about the maximum, in σ, the logarithms of one unknown's density there, and the best fit."""
    step, along = spacing * found.std[i], spacing * found.covariance[:, i] / found.std[i]
    told, ends, best = {0: _log_density(found, i)}, [], found
    for side in (-1, 1):
        x = found.x
        for k in side * np.arange(1, round(_FURTHEST / spacing) + 1):
            held = _Held(problem, i, float(found.x[i] + k * step))
            if not found.unknowns.lower[i] <= held.value <= found.unknowns.upper[i]:
                break
            there = descend(held, found.scatters, held.unknowns.clipped(x + side * along), steps=_STEPS)
            told[int(k)] = _log_density(there, i)
            x, best = there.x, min(best, there, key=lambda p: p.cost)
            if not told[int(k)] > max(told.values()) - _LOW:
                ends.append(abs(k * spacing))
                break
    if spacing > _FINE and min(ends, default=_STEEP) < _STEEP:
        return _profile(problem, found, i, _FINE)
    places = [k for k in sorted(told) if np.isfinite(told[k])]
    return spacing * np.array(places, float), np.array([told[k] for k in places]), best


def _log_density(at: Posterior, i: int) -> float:
    """Of one unknown where the others are at their best, these allowed for by their precision."""
    if not np.isfinite(at.cost):
        return -np.inf
    others = np.arange(len(at.x)) != i
    half_log_det = float(np.sum(np.log(np.diag(lower_factor(at.information[np.ix_(others, others)])))))
    beyond = 0.0
    if at.unknowns.names[i] in at.unknowns.sizes:
        beyond = 0.5 * max(abs(float(at.x[i] / at.prior_std[i])) - LARGE, 0.0) ** 2
    return beyond - at.cost - half_log_det


class _Held:
    """A problem with one unknown held.

    Parameters
    ----------
    problem : Problem
    i : int
        Its position.
    value : float
    """

    def __init__(self, problem: Problem, i: int, value: float) -> None:
        self.value = value
        u = problem.unknowns
        lower, upper = u.lower.copy(), u.upper.copy()
        lower[i] = upper[i] = value
        self.unknowns = replace(u, lower=lower, upper=upper)
        self.residuals = problem.residuals
