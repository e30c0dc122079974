"""Frequencies of a hit that are all off together: the temperature has changed since the first one, not the force."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_LEAST_MODES, _LEAST_SHARE = 3, 0.25
"""Modes, and share of all, that move together at least where that is a drift."""
_LEFT = 0.25
"""Share of a mode's movement, squared, that another one's leaves of it, below which the two move together."""


def common_drift(frequency_hz: Real, std_hz: Real, sheet: NDArray[np.int64]) -> Real:
    """Relative shift that all modes of a hit have in common, from the mean of its sheet, (n_hits,).

    Who strikes every point softly first and hard last finds all frequencies moved with the force on a day that grows
    warmer. A nonlinearity moves each mode by another amount. 0 where modes do not move together, or are fewer than
    three.

    Parameters
    ----------
    frequency_hz, std_hz : ndarray, (n_hits, n_modes)
        ``inf`` standard deviations where a hit tells nothing.
    sheet : ndarray of int, (n_hits,)
        Hits of one sheet share impact point and sensors.
    """
    drift = np.zeros(len(sheet))
    for s in np.unique(sheet):
        on = np.flatnonzero(sheet == s)
        known = np.isfinite(std_hz[on]) & np.isfinite(frequency_hz[on]) & (std_hz[on] > 0)
        modes = np.flatnonzero(known.all(axis=0))
        if len(modes) < _LEAST_MODES:
            continue
        hz, std = frequency_hz[np.ix_(on, modes)], std_hz[np.ix_(on, modes)]
        log, weight = np.log(hz), (hz / std) ** 2
        moved = log - np.sum(weight * log, axis=0) / np.sum(weight, axis=0)
        left = np.einsum("hk,hrk->rk", weight, (moved[:, None, :] - moved[:, :, None]) ** 2)
        alike = left < _LEFT * np.sum(weight * moved**2, axis=0)
        count = np.sum(alike, axis=1)
        if count.max() >= max(_LEAST_MODES, _LEAST_SHARE * len(modes)):
            drift[on] = np.median(moved[:, alike[np.argmax(count)]], axis=1)
    return drift
