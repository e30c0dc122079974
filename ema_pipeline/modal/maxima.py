"""Peaks of a curve by their prominence.

As `scipy.signal.find_peaks`, without what importing `scipy.signal` takes: 40 MB and half a second.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


def prominent_peaks(curve: Real, prominence: float) -> tuple[NDArray[np.int64], Real]:
    """Local maxima that stand out of a curve.

    Parameters
    ----------
    curve : ndarray, (n_lines,)
    prominence : float
        Least height of a peak over the higher one of its two bases: the lowest points between it and the next higher
        points, or the ends of the curve.

    Returns
    -------
    places : ndarray of int, (n_peaks,)
        The middle of a flat top, rounded down.
    prominences : ndarray, (n_peaks,)
    """
    first, last = _tops(curve)
    if not len(first):
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    edges = [0, *first.tolist(), len(curve)]
    between = [float(curve[a:b].min()) for a, b in pairwise(edges)]
    heights = curve[first].tolist()
    left = np.array(_bases(heights, between[:-1]))
    right = np.array(_bases(heights[::-1], between[:0:-1])[::-1])
    rise = np.array(heights) - np.maximum(left, right)
    kept = rise >= prominence
    return (first + last)[kept] // 2, rise[kept]


def _tops(curve: Real) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last lines of the tops, flat ones counted once; the ends of the curve are none."""
    steps = np.flatnonzero(np.diff(curve) != 0)  # the curve changes behind these lines
    rising = np.diff(curve)[steps] > 0
    top = np.flatnonzero(rising[:-1] & ~rising[1:])
    return steps[top] + 1, steps[top + 1]


def _bases(heights: list[float], lowest: list[float]) -> list[float]:
    """Lowest point between each peak and the next higher one before it, or the beginning.

    Parameters
    ----------
    heights : list of float
    lowest : list of float
        Lowest point between each peak and the one before it.
    """
    out: list[float] = []
    higher: list[tuple[float, float]] = []  # peaks that may still be the next higher one, with their bases
    for height, base in zip(heights, lowest, strict=True):
        while higher and higher[-1][0] <= height:
            base = min(base, higher.pop()[1])
        higher.append((height, base))
        out.append(base)
    return out
