"""Channels of an analyser's export that are no records of their own: windowed copies and impulse responses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from ema_pipeline.ingest.readers.raw import RawChannel

SIGNIFICANT = 1e-3
"""Samples above this share of the largest tell the ratio of two channels."""

SMOOTH = 0.02
"""Windows change by less than this from one sample to the next."""

EXACT = 1e-4
"""A computed window bends by less than this; the ratio of two sensors side by side carries their noise."""

FEWEST = 6
"""Samples that tell: a short force pulse has few."""

OPEN = 0.9
"""A window lets some part of the record pass; two sensors that move alike differ by a factor throughout."""

ALIKE = 0.9
"""Correlation from which on a channel, convolved with the force, is a response."""

Real = NDArray[np.float64]


def derived_channels(channels: Mapping[str, RawChannel], hammer: str | None = None) -> dict[str, str]:
    """Channels that were computed from others, each with what it is in words.

    Parameters
    ----------
    channels : mapping of str to RawChannel
        All of one length.
    hammer : str, optional
        The force; impulse responses are looked for where it is known.
    """
    samples = {name: np.asarray(c.samples, dtype=np.float64) for name, c in channels.items()}
    found: dict[str, str] = {}
    for number, (name, mine) in enumerate(samples.items()):
        for earlier, (other, x) in enumerate(samples.items()):
            if other in found or other == name or not _windowed(mine, x):
                continue
            equal = np.array_equal(mine, x)
            if not equal or earlier < number:  # of two that are equal the first is kept
                found[name] = f"a copy of '{other}'" + ("" if equal else " under a window")
                break
    if hammer is None or hammer in found:
        return found
    forces = [samples[n] for n in (hammer, *(c for c in found if f"'{hammer}'" in found[c]))]
    for name, mine in samples.items():
        # among responses that one mode rules, any looks like the other's impulse response: the unit must betray it
        if name not in found and name != hammer and channels[name].unit == channels[hammer].unit:
            others = [x for other, x in samples.items() if other not in (name, hammer)]
            if any(_convolves(mine, force, x) for force in forces for x in others):
                found[name] = "an impulse response"
    return found


def _windowed(mine: Real, other: Real) -> bool:
    """True where `mine` is `other` times a smooth factor between 0 and 1."""
    if mine.size != other.size or not np.all(np.isfinite(mine)) or not np.all(np.isfinite(other)):
        return False
    seen = np.flatnonzero(np.abs(other) > SIGNIFICANT * np.max(np.abs(other), initial=0.0))
    if seen.size < FEWEST or np.sum(mine**2) > np.sum(other**2):
        return False
    ratio = mine[seen] / other[seen]
    steps = np.abs(np.diff(ratio))
    within = ratio.min() > -SMOOTH and OPEN < ratio.max() < 1 + SMOOTH
    smooth = np.median(steps) < SMOOTH and np.percentile(steps, 95) < 5 * SMOOTH
    return bool(within and smooth and np.median(np.abs(np.diff(ratio, 2))) < EXACT)


def _convolves(response: Real, force: Real, measured: Real) -> bool:
    """True where `response` convolved with the force, periodically, has the shape of what was measured."""
    if not (response.size == force.size == measured.size) or not np.all(np.isfinite(response)):
        return False
    made = irfft(rfft(response) * rfft(force), response.size)
    made, measured = made - made.mean(), measured - measured.mean()
    size = float(np.linalg.norm(made) * np.linalg.norm(measured))
    return size > 0 and abs(float(made @ measured)) > ALIKE * size
