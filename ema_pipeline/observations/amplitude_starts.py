"""Where fits of effects that depend on the amplitude begin: sizes tried over many decades.

From far off there is often no slope that leads to the right size: teeth that never part, friction that locks, and a
quadratic spring of no size change nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import Residuals
from ema_pipeline.observations.hit_lattice import SPACING
from ema_pipeline.observations.size_map import LOG_STD, SizeMap

if TYPE_CHECKING:
    from ema_pipeline.observations.amplitude import AmplitudeProblem

_DECADES = 6.0
_ALONG, _ACROSS, _FINE = 19, 3, 41
"""Sizes that are tried to begin with: their range, and their number for an effect's first size and the others; of teeth
for their preload alone."""
_LOWEST = 3
"""Most of them that fits begin at."""
_HOPELESS, _IN_A_ROW = 1000.0, 3
"""Log density by which a preload is so far behind the best one that nothing leads from there; after so many in a row
all smaller ones are: teeth that rattle on, which take longest to march."""
_FACTORS = tuple(np.geomspace(1.0, 32.0, 6))
"""Of the linearised size of what is calculated in full: sizes from which fits begin."""
_BESIDE = (-2, -1, 1, 2)
"""Places of the lattice about these that are tried, too: between two sizes of the grid others may fit far better."""


def begun(
    problem: AmplitudeProblem, x: NDArray[np.float64], scatters: Mapping[str, float]
) -> list[NDArray[np.float64]]:
    """`x` with the sizes of the effect added last at the best of a grid; nothing where it is linear.

    Rows far off count by their logarithm: what other unknowns will take up must not outweigh what most rows say. Of
    teeth, whose rows go up and down with the size, some lowest points count, once all else has followed.
    """
    last = problem.model.effects[-1] if problem.model.effects else None
    if last is None or last.effect.linear or not problem.observations.hits:
        return []
    names = [last.parameter_name(p.name) for p in last.effect.parameters]
    at = [problem.unknowns.index[n] for n in names]
    marched = set(at) <= set(problem.marched_sizes)
    counts = (_FINE, *[1] * (len(names) - 1)) if marched else (_ALONG, *[_ACROSS] * (len(names) - 1))
    grids = [_grid(problem.sizes[n], count) for n, count in zip(names, counts, strict=True)]
    matching = problem.residuals(x, scatters, derivatives=False).matching

    def tried(values: Sequence[float]) -> tuple[float, NDArray[np.float64]]:
        trial = x.copy()
        trial[at] = values
        if marched:
            trial = problem.uninterpolated(trial)
        found = problem.residuals(trial, scatters, matching=matching, derivatives=marched, by_sizes=False)
        if marched:
            return 0.5 * _followed(problem, found, trial, scatters, at), trial
        return 0.5 * float(np.sum(np.log1p(found.values**2)) + np.sum(np.square(values))), trial

    places = list(itertools.product(*grids))
    tries = _while_hopeful(tried, places) if marched else [tried(values) for values in places]
    places = places[-len(tries) :]
    costs = np.array([cost for cost, _ in tries])
    if not marched:
        return [tries[int(np.argmin(costs))][1]] if np.isfinite(min(costs)) else [x]
    around = np.concatenate([[np.inf], costs, [np.inf]])
    lowest = np.flatnonzero((costs < around[:-2]) & (costs < around[2:]) & (costs < min(costs) + _HOPELESS))
    best = []
    for i in sorted(lowest, key=lambda i: costs[i])[:_LOWEST]:
        near = [(places[i][0] + k * SPACING, *places[i][1:]) for k in _BESIDE]
        best.append(min([tries[i], *map(tried, near)], key=lambda one: one[0]))
    return [trial for _, trial in sorted(best, key=lambda one: one[0])] or [x]


def sized_anew(problem: AmplitudeProblem, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Multiples of the first size of what is calculated in full, its other sizes as usual."""
    starts = [x]
    for effect in problem.effects:
        if effect.label not in problem.observations.rubbing:
            continue
        i, *others = (problem.unknowns.index[effect.parameter_name(p.name)] for p in effect.effect.parameters)
        size, usual, tried = problem.sizes[problem.unknowns.names[i]], problem.start()[others], []
        for start, factor in itertools.product(starts, _FACTORS):
            trial = start.copy()
            trial[i] = size.of_coordinate(factor * size.coordinate(start[i]))
            trial[others] = usual
            tried.append(problem.unknowns.clipped(trial))
        starts = tried
    return starts


def _followed(
    problem: AmplitudeProblem,
    found: Residuals,
    x: NDArray[np.float64],
    scatters: Mapping[str, float],
    held: Sequence[int],
) -> float:
    """Twice the cost once all unknowns but those `held` have followed in one step.

    What is seen of a structure at any force is what the teeth leave of it: its parts are not where the linear model
    found them.
    """
    prior = problem.unknowns.prior_std(scatters)
    free = np.setdiff1d(np.arange(len(x)), held)
    jacobian = found.jacobian[:, free] * prior[free]
    at = x[free] / prior[free]
    slope = jacobian.T @ found.values + at
    normal = jacobian.T @ jacobian + np.eye(len(free))
    return float(
        found.values @ found.values + np.sum((x / prior) ** 2) - slope @ np.linalg.solve(normal, slope)
    )


def _while_hopeful(
    tried: Callable[[Sequence[float]], tuple[float, NDArray[np.float64]]], places: Sequence[Sequence[float]]
) -> list[tuple[float, NDArray[np.float64]]]:
    """The last places tried, from where sizes, down from the largest, are hopeless."""
    found: list[tuple[float, NDArray[np.float64]]] = []
    best = np.inf
    for values in reversed(places):
        found.append(tried(values))
        best = min(best, found[-1][0])
        if len(found) >= _IN_A_ROW and all(cost > best + _HOPELESS for cost, _ in found[-_IN_A_ROW:]):
            break
    return found[::-1]


def _grid(size: SizeMap, points: int) -> NDArray[np.float64]:
    """Unknowns of a size to try: evenly over `_DECADES` decades of it, of both signs where it has two."""
    low, high = size.bounds
    if size.logarithmic:
        reach = 0.5 * _DECADES * np.log(10) / LOG_STD
        grid = np.linspace(-reach, reach, points) if points > 1 else np.zeros(1)
    else:
        one = np.logspace(1 - _DECADES, 1, points)
        grid = np.concatenate([one, -one])
    return np.asarray(grid[(grid >= low) & (grid <= high)])
