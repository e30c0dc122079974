"""Profile likelihood: how well can the model still do with one parameter held away from its best value?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.fit.solve import FitProblem, Optimum, descend
from ema_pipeline.fit.types import Profile

_MOST_STEPS = 14


def profile(
    problem: FitProblem,
    best: Optimum,
    covariance: NDArray[np.float64],
    index: int,
    scale: float,
) -> tuple[Profile, Optimum]:
    """Profile of one coordinate around an optimum.

    The coordinate is stepped outwards on both sides, the others refitted from the last point (first shifted
    along
    the posterior's ridge). It goes on, with growing steps, until the objective has risen by `profile_rise` or
    a
    bound is reached.

    Parameters
    ----------
    problem : FitProblem
    best : Optimum
    covariance : ndarray, (P, P)
        Posterior covariance of the coordinates.
    index : int
        Coordinate to profile.
    scale : float
        Misfit scale of `best`.

    Returns
    -------
    profile : Profile
        Values of the parameter in ascending order.
    lowest : Optimum
        The lowest point met; better than `best` where the search had missed the optimum.
    """
    space, settings = problem.space, problem.settings
    sigma = float(np.sqrt(covariance[index, index]))
    ridge = covariance[:, index] / covariance[index, index]
    low, high = float(space.low[index]), float(space.high[index])
    points = [(float(best.x[index]), 0.0)]
    lowest = best
    for side, bound in ((-1.0, low), (1.0, high)):
        x, step, rise = best.x, 3 * sigma / settings.profile_points, 0.0
        for n in range(_MOST_STEPS):
            if rise >= max(settings.profile_rise, 9.0) or x[index] == bound:
                break
            if n >= settings.profile_points:
                step *= 1.6
            if n == _MOST_STEPS - 1:
                step = abs(bound - x[index]) if np.isfinite(bound) else step
            target = float(np.clip(x[index] + side * step, low, high))
            found = _held(problem, x + ridge * (target - x[index]), index, target, scale)
            x, rise = found.x, found.objective - best.objective
            points.append((target, rise))
            if found.objective < lowest.objective:
                lowest = found
    points.sort()
    coordinate = space.coordinates[index]
    values = np.array([coordinate.value(p) for p, _ in points])
    return Profile(values, np.array([r for _, r in points])), lowest


def interval(p: Profile, low: float, high: float, logarithmic: bool) -> tuple[float, float]:
    """68 % interval: where the profile crosses 1, linear between its points; at a bound where it does not.

    Parameters
    ----------
    p : Profile
    low, high : float
        Bounds of the parameter.
    logarithmic : bool
        Interpolate over the logarithm of the value.
    """
    axis = np.log(p.values) if logarithmic else p.values
    at = int(np.argmin(p.objective))
    # the root of the rise is close to linear in the value: it is exactly so for a parabola
    rise = np.sqrt(np.maximum(p.objective - p.objective[at], 0.0))
    ends = []
    for order, bound in ((np.arange(at, -1, -1), low), (np.arange(at, axis.size), high)):
        above = np.flatnonzero(rise[order] >= 1.0)
        if above.size == 0:
            ends.append(float(bound))
            continue
        j = order[above[0]]
        i = order[above[0] - 1]
        crossing = axis[i] + (1.0 - rise[i]) / (rise[j] - rise[i]) * (axis[j] - axis[i])
        ends.append(float(np.exp(crossing) if logarithmic else crossing))
    return ends[0], ends[1]


def _held(
    problem: FitProblem, start: NDArray[np.float64], index: int, target: float, scale: float
) -> Optimum:
    """Best fit with one coordinate held; with the pairs of the start, and with new ones if they differ."""
    space = problem.space
    x = np.clip(start, space.low, space.high)
    x[index] = target
    held = np.zeros(x.size, dtype=bool)
    held[index] = True
    mixture = problem.mixture(scale)
    pairs = problem.assignments(x)
    found = descend(problem.exact(pairs), space, x, mixture, 8, held)
    again = problem.assignments(found.x)
    if any(not np.array_equal(p, q) for p, q in zip(pairs, again, strict=True)):
        other = descend(problem.exact(again), space, found.x, mixture, 8, held)
        if other.objective < found.objective:
            found = other
    return found
