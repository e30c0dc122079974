"""Blocks that a recorder has lost: one exact value for long, amid a signal that never stands still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHORTEST = 64
"""Samples; noise of a few converter steps does not repeat one value for half as long in a lifetime."""

RESOLVED_STEPS = 3.0
"""Typical distance of the samples on both sides, converter steps, from which on they cannot rest at one value."""

ABRUPT_STEPS = 2.5
"""A signal that comes to rest gets there step by step; where a block is lost it breaks off."""

HELD_SHARE = 0.5
"""Share of samples like the one before from which on a signal is made of steps: then it rests on purpose."""

OFF_CENTRE = 0.1
"""Distance from the median over the standard deviation from which on a record did not simply come to rest."""


def frozen_stretch(samples: NDArray[np.float64], step: float) -> tuple[int, int]:
    """The longest stretch at which a channel of a continuous record stood still, also at its beginning or end.

    There it is no loss only near the median, where a signal begins and comes to rest.

    Parameters
    ----------
    samples : ndarray, (n_samples,)
    step : float
        The converter's step, see `pulse.step_of`.

    Returns
    -------
    start, stop : int
        Equal where there is none, and in signals that are made of steps.
    """
    changes = np.flatnonzero(np.diff(samples))
    if changes.size < (1 - HELD_SHARE) * samples.size:
        return 0, 0
    found = [lost_stretch(samples, step)]
    first, last = int(changes[0]) + 1, int(changes[-1]) + 1
    moving = samples[first:last]
    off = OFF_CENTRE * float(np.std(moving))
    for start, stop, next_to_it in ((0, first, first), (last, samples.size, last - 1)):
        breaks_off = abs(samples[next_to_it] - samples[start]) > ABRUPT_STEPS * step
        if stop - start >= SHORTEST and breaks_off and abs(samples[start] - np.median(moving)) > off:
            found.append((start, stop))
    return max(found, key=lambda stretch: stretch[1] - stretch[0])


def lost_stretch(samples: NDArray[np.float64], step: float) -> tuple[int, int]:
    """The longest stretch of one value amid a signal that is alive on both sides of it.

    What stands still at the beginning (before the trigger), at the end (decayed, windowed, padded), or where the signal
    is about as small as the converter's step is no loss.

    Parameters
    ----------
    samples : ndarray, (n_samples,)
    step : float
        The converter's step, see `pulse.step_of`.

    Returns
    -------
    start, stop : int
        Equal where there is none.
    """
    changes = np.flatnonzero(np.diff(samples))
    if changes.size < 2:
        return 0, 0
    # A stretch goes from behind one change to the next one; what is before the first and behind the last is no loss.
    starts, stops = changes[:-1] + 1, changes[1:] + 1
    for k in np.argsort(starts - stops, kind="stable"):
        start, stop = int(starts[k]), int(stops[k])
        length = stop - start
        if length < SHORTEST:
            break
        beside = (samples[max(start - length, 0) : start], samples[stop : stop + length])
        alive = all(np.median(np.abs(x - samples[start])) > RESOLVED_STEPS * step for x in beside)
        edges = np.abs(samples[[start - 1, stop]] - samples[start])
        if alive and edges.max() > ABRUPT_STEPS * step:
            return start, stop
    return 0, 0
