"""Visible sizes of what a hypothesis adds, tried without any fit: where to start from when modes were lost.

A base model that explains most modes and drops the others as outliers is no place to start from: outliers no longer
pull. With uncertainties widened they do, and the most likely size at the base model's values is then near the truth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import Extra
from ema_pipeline.fit.solve import FitProblem

_FREQUENCY, _DAMPING = 3e-3, 0.15
"""Relative errors of frequency and damping that the widened uncertainties allow, whatever the noise level."""
_REACH = 300.0
"""Sizes are tried from a start over to a start times this much, in steps of a factor of two or so."""
_SINGLE = 17
_FINER = (0.6, 0.8, 1.25, 1.6)
_MOST = 80
_PROMISE = 3.0
"""Fall of -2 log likelihood, uncertainties widened, from which a size is worth a fit."""


def scanned(
    problem: FitProblem, base: Mapping[str, float], moved: Sequence[Extra], count: int = 2
) -> list[NDArray[np.float64]]:
    """The most likely sizes at the values of a poorer model, all uncertainties widened.

    Parameters
    ----------
    problem : FitProblem
        Of the hypothesis.
    base : mapping of parameter to value
        Optimum of the poorer model.
    moved : sequence of Extra
        What the hypothesis adds.
    count : int
        How many, of which no two are neighbours.

    Returns
    -------
    list of ndarray, (P,)
        The most likely first.
    """
    given = math.prod(len(e.starts) for e in moved if e.scale == 0)
    count_each = max(min(_SINGLE, int((_MOST / given) ** (1 / max(sum(e.scale > 0 for e in moved), 1)))), 3)
    axes = [_axis(problem, e, count_each) for e in moved]
    least = np.inf
    if any(e.scale > 0 for e in moved):
        absent = tuple(_smallest(axis, e) for axis, e in zip(axes, moved, strict=True))
        least = _cost(problem, base, moved, absent) - _PROMISE
    tried = [(_cost(problem, base, moved, v), v) for v in list(product(*axes))[:_MOST]]
    chosen = _apart([(cost, sizes) for cost, sizes in tried if cost <= least], count)
    return [_point(problem, base, moved, _finer(problem, base, moved, sizes)) for sizes in chosen]


def likeliest(
    problem: FitProblem,
    base: Mapping[str, float],
    moved: Sequence[Extra],
    sizes: Sequence[Mapping[str, float]],
    count: int = 3,
) -> list[NDArray[np.float64]]:
    """The most likely of given sizes at the values of a poorer model, all uncertainties widened.

    Parameters
    ----------
    problem, base, moved
        As for `scanned`.
    sizes : sequence of mapping of parameter to value
    count : int
        How many, of which no two are neighbours.

    Returns
    -------
    list of ndarray, (P,)
        The most likely first.
    """
    points = [tuple(s[e.name] for e in moved) for s in sizes]
    tried = [(_cost(problem, base, moved, v), v) for v in points]
    return [_point(problem, base, moved, v) for v in _apart(tried, count)]


def _apart(tried: Sequence[tuple[float, tuple[float, ...]]], count: int) -> list[tuple[float, ...]]:
    """Sizes of the lowest costs of which no two are neighbours."""
    chosen: list[tuple[float, ...]] = []
    for _, sizes in sorted(tried, key=lambda t: t[0]):
        if len(chosen) == count:
            break
        if all(not _near(sizes, other) for other in chosen):
            chosen.append(sizes)
    return chosen


def _smallest(axis: Sequence[float], e: Extra) -> float:
    """The size next to null; of a quantity without one any."""
    return min(axis, key=lambda v: abs(v - e.null)) if e.scale > 0 else axis[0]


def _axis(problem: FitProblem, e: Extra, count: int) -> list[float]:
    """Sizes on both sides of null, evenly over their logarithm; quantities without a null at their starts."""
    c = problem.space.coordinates[problem.space.names.index(e.name)]
    if e.scale == 0:
        return list(e.starts)
    if c.kind == "log":
        return [v for v in e.null * np.geomspace(0.1, 10, count) if c.low <= np.log(v) <= c.high]
    sizes = []
    for start in e.starts:
        distances = (start - e.null) * np.geomspace(1 / _REACH, _REACH, count)
        sizes += [e.null + float(d) for d in distances if c.low <= (e.null + d) / c.scale <= c.high]
    return sizes


def _finer(
    problem: FitProblem, base: Mapping[str, float], moved: Sequence[Extra], sizes: tuple[float, ...]
) -> tuple[float, ...]:
    """A few more sizes about one, for the first quantity that has a null."""
    first = next((i for i, e in enumerate(moved) if e.scale > 0), None)
    if first is None:
        return sizes
    null = 0.0 if moved[first].null == sizes[first] else moved[first].null
    about = [(*sizes[:first], null + k * (sizes[first] - null), *sizes[first + 1 :]) for k in (1.0, *_FINER)]
    return min(about, key=lambda v: _cost(problem, base, moved, v))


def _point(
    problem: FitProblem, base: Mapping[str, float], moved: Sequence[Extra], sizes: tuple[float, ...]
) -> NDArray[np.float64]:
    named = dict(zip((e.name for e in moved), sizes, strict=True))
    return problem.space.point({**base, **named})


def _cost(
    problem: FitProblem, base: Mapping[str, float], moved: Sequence[Extra], sizes: tuple[float, ...]
) -> float:
    x = _point(problem, base, moved, sizes)
    damping_only = all(problem.damping_only[problem.space.names.index(e.name)] for e in moved)
    s = problem.settings
    widened = (_DAMPING, s.damping_floor) if damping_only else (_FREQUENCY, s.frequency_floor)
    mixture = problem.mixture(max(widened[0] / max(widened[1], 1e-6), 1.0))
    costs = problem.exact(problem.assignments(x)).costs(x)
    return float(np.sum(mixture.robust(costs)))


def _near(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Within a factor of three in every quantity."""
    return all(u == v or (u * v > 0 and abs(np.log(u / v)) < np.log(3.0)) for u, v in zip(a, b, strict=True))
