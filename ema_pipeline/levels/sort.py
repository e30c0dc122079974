"""Hits into force levels: clusters of the peak forces that stand clearly apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

APART = 4.0
"""Distance of neighbouring levels in standard deviations within levels (of log force). Half a normal
distribution lies 2.7 such deviations from the other half, half a uniform one 3.5: neither is split."""

SCATTER = 0.08
"""Scatter of a practised hand on one level, relative; the prior of the scatter within levels."""

SCATTER_DOF = 2.0
"""Weight of that prior, in degrees of freedom."""

MOST_LEVELS = 8

MEANT = 0.85
"""Share of the pairs of point and level that have a hit, from which levels were meant. Two hits at each of five points,
of 60 to 180 N as they happened to be, made two levels that three points had both of."""


def sort_levels(points: Sequence[str], forces_n: Sequence[float], level_ratio: float) -> Integers:
    """Sort hits into force levels.

    Parameters
    ----------
    points : sequence of str
        Impact point of every hit.
    forces_n : sequence of float
        Peak force of every hit, positive.
    level_ratio : float
        Least ratio between the forces of neighbouring levels.

    Returns
    -------
    ndarray of int, (n_hits,)
        Level of every hit, 0 for the softest; all 0 where no point was struck at two levels, since then
        points would be compared instead of forces, or where they came about by chance: most points were struck at some
        levels only, and none twice at each of two.

    Notes
    -----
    The largest number of clusters is taken that still stand `level_ratio` and `APART` standard deviations
    apart. The forces are clustered as they are, and relative to the mean of each point, which lets every
    point have its own; the second is taken where it makes more points take part in more levels.
    """
    log_force = np.log(np.asarray(forces_n, dtype=float))
    _, place = np.unique(np.asarray(points), return_inverse=True)
    mean = np.bincount(place, log_force) / np.bincount(place)
    direct = _clusters(log_force, float(np.log(level_ratio)))
    relative = _clusters(log_force - mean[place], float(np.log(level_ratio)))
    levels = direct if _filled(place, direct) >= _filled(place, relative) else relative
    hits = [np.unique(levels[place == p], return_counts=True)[1] for p in range(len(mean))]
    at_two = any(len(count) > 1 for count in hits)
    meant = _filled(place, levels) >= MEANT or any(np.sum(count > 1) > 1 for count in hits)
    return levels if at_two and meant else np.zeros(len(levels), dtype=np.int64)


def _filled(place: Integers, levels: Integers) -> float:
    """Share of the pairs of point and level that have a hit, for one level 0: it tells nothing."""
    if levels.max() == 0:
        return 0.0
    return len(set(zip(place.tolist(), levels.tolist(), strict=True))) / (
        (place.max() + 1) * (levels.max() + 1)
    )


def _clusters(values: Real, least: float) -> Integers:
    """Cluster of each value, in rising order, for the largest number of clusters that stand apart."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    labels = np.zeros(len(values), dtype=np.int64)
    for k in range(min(MOST_LEVELS, len(values)), 1, -1):
        cuts = _best_cuts(ordered, k)
        parts = np.split(ordered, cuts)
        means = np.array([p.mean() for p in parts])
        within = sum(float(np.sum((p - m) ** 2)) for p, m in zip(parts, means, strict=True))
        scatter = np.sqrt((within + SCATTER_DOF * SCATTER**2) / (len(values) - k + SCATTER_DOF))
        if np.diff(means).min() >= max(least, APART * scatter):
            labels[order] = np.repeat(np.arange(k), [len(p) for p in parts])
            break
    return labels


def _best_cuts(ordered: Real, k: int) -> list[int]:
    """Starts of clusters 1…k-1 that make the sum of squares within k clusters least."""
    n = len(ordered)
    total = np.concatenate([[0.0], np.cumsum(ordered)])
    square = np.concatenate([[0.0], np.cumsum(ordered**2)])
    first, last = np.arange(n)[:, None], np.arange(1, n + 1)[None]
    count = np.maximum(last - first, 1)
    cost = square[last] - square[first] - (total[last] - total[first]) ** 2 / count
    cost = np.where(last > first, cost, np.inf)  # of one cluster first:last
    best = cost[0]
    back = []
    for _ in range(k - 1):
        # best[j] so far ends a cluster after j + 1 values; the next one starts there
        options = best[:-1, None] + cost[1:]
        back.append(np.argmin(options, axis=0) + 1)
        best = options.min(axis=0)
    cuts, end = [], n
    for choice in reversed(back):
        end = int(choice[end - 1])
        cuts.append(end)
    return cuts[::-1]
