"""Clipping seen from the samples alone: flat tops, also with noise on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MINIMUM_FLAT = 3
"""A top of fewer samples may be flat by chance."""

MANY_FLAT = 8
"""Samples at one extreme value, in runs, that are no chance either."""

SIGNIFICANT = 30
"""Excursions of fewer noise deviations have no top to speak of."""


def flat_top_share(samples: NDArray[np.float64], noise: float) -> float:
    """How flat the highest or lowest tops are: 0.5 for smooth peaks, 1 for clipped ones, 0 if undecidable.

    Near any smooth peak the signal is a parabola, so that it stays within ε of its top for a time that
    grows with √ε: half as long within ε as within 4ε. The same ratio of 1/2 holds for the number of samples
    that many periods of a steady vibration spend there, and for a decaying one it is lower. Of a clipped
    top all samples lie within the noise that the converter adds after clipping; so ε is 6 deviations of
    that noise.

    Parameters
    ----------
    samples : ndarray, (n_samples,)
    noise : float
        Standard deviation of the channel's noise, see `pulse.noise_of`.

    Returns
    -------
    float
        The larger over both polarities of: time within ε over time within 4ε in the lobe with the top
        (where at least three samples lie there), and the same for sample counts over all lobes (where they
        are too many to be chance).
    """
    middle = float(np.median(samples))
    return max(_side(samples - middle, noise), _side(middle - samples, noise))


def stands_at_top(samples: NDArray[np.float64]) -> bool:
    """True where the highest or the lowest value is held to the last digit, again and again, as noise never does."""
    for top in (samples.max(), samples.min()):
        held = np.concatenate([[False], samples == top, [False]])
        edges = np.flatnonzero(np.diff(held))
        runs = edges[1::2] - edges[::2]
        if runs[runs >= MINIMUM_FLAT].sum() >= MANY_FLAT:
            return True
    return False


def _side(x: NDArray[np.float64], noise: float) -> float:
    at = int(np.argmax(x))
    top = float(x[at])
    epsilon = max(6 * noise, 1e-6 * top)
    # 4ε must stay in the upper part of the lobe, where it still is a parabola.
    if top <= 0 or top < SIGNIFICANT * noise or 4 * epsilon > 0.6 * top:
        return 0.0
    return max(_one_lobe(x, at, top, epsilon), _all_lobes(x, top, epsilon))


def _one_lobe(x: NDArray[np.float64], at: int, top: float, epsilon: float) -> float:
    low = at - int(np.argmax(x[at::-1] < 0.3 * top)) if np.any(x[at::-1] < 0.3 * top) else 0
    high = at + int(np.argmax(x[at:] < 0.3 * top)) if np.any(x[at:] < 0.3 * top) else x.size - 1
    lobe = x[low : high + 1]
    flat = np.flatnonzero(lobe >= top - epsilon)
    if flat.size < MINIMUM_FLAT or flat.size < 0.8 * (flat[-1] - flat[0] + 1):
        return 0.0
    flat_time = _span(lobe, top - epsilon)
    share = flat_time / max(_span(lobe, top - 4 * epsilon), 1e-12)
    if 16 * epsilon <= 0.15 * top:
        # Two humps side by side look flat within 4ε; within 16ε they are as round as any: a quarter.
        share = min(share, float(np.sqrt(flat_time / max(_span(lobe, top - 16 * epsilon), 1e-12))))
    return share


def _span(lobe: NDArray[np.float64], level: float) -> float:
    """Time from the first to the last crossing of a level, samples, crossings interpolated."""
    above = np.flatnonzero(lobe >= level)
    first, last = int(above[0]), int(above[-1])
    left = (lobe[first] - level) / (lobe[first] - lobe[first - 1]) if first > 0 else 0.0
    right = (lobe[last] - level) / (lobe[last] - lobe[last + 1]) if last < lobe.size - 1 else 0.0
    return float(last - first + left + right)


def _all_lobes(x: NDArray[np.float64], top: float, epsilon: float) -> float:
    near = int(np.count_nonzero(x >= top - epsilon))
    wide = int(np.count_nonzero(x >= top - 4 * epsilon))
    # By chance half of `wide` lie in the upper quarter: 5 deviations of the binomial above that.
    return near / wide if near >= 8 and near - 0.5 * wide >= 2.5 * np.sqrt(wide) else 0.0
