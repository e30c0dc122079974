"""The hammer pulse as an array: where it lies, how noisy its channel is, and whether it struck twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

HORIZON_S = 0.1
"""Time about the peak in which a second impact is searched on the DC-restored force."""

MINIMUM_DELAY_S = 1.2e-3
"""A shoulder sooner after the peak is contact dynamics of one blow: a hammer cannot come back that fast."""

VALLEY = 0.012
"""Depth of the valley before a second impact, over the peak, below which noise may have made it."""


DEEP = 0.04
"""Depth of a valley that only a shoulder can make, whose own height is then looked at."""


NOISE_BLOCK = 64
"""Samples of a stretch that may be the quietest."""


RESOLVED = 8.0
"""Width of a pulse, samples, from which on a shoulder is more than the filter's ringing."""


@dataclass(frozen=True)
class Pulse:
    """Where a force pulse lies in its samples.

    Attributes
    ----------
    peak : int
        Sample of the peak.
    start, stop : int
        Samples ``start:stop`` lie above 2 % of the peak, or above the noise.
    width : float
        Width at half the peak, samples.
    sign : int
        +1 or -1: polarity of the hammer channel.
    baseline : float
        Level without force.
    height : float
        Peak above the baseline, positive.
    """

    peak: int
    start: int
    stop: int
    width: float
    sign: int
    baseline: float
    height: float


@dataclass(frozen=True)
class SecondImpact:
    """The strongest sign of a second impact.

    Attributes
    ----------
    ratio : float
        Its peak over that of the main impact, less the ringing about it; 0 where there is none.
    delay_s : float
        Its time after the main impact; negative where it comes before.
    """

    ratio: float
    delay_s: float


def noise_of(samples: NDArray[np.float64], step: float | None = None) -> float:
    """Standard deviation of a channel's broadband noise, from its quietest stretches.

    Second differences take offset, drift and slow vibration away; the tenth percentile over blocks takes
    the hit away. Never less than the rounding error of the converter's step.

    Parameters
    ----------
    samples : ndarray, (n_samples,)
    step : float, optional
        The converter's step, where it is known already.
    """
    if samples.size < 4:
        return 0.0
    bend = np.diff(samples, 2)
    if bend.size >= 4 * NOISE_BLOCK:
        blocks = bend[: bend.size // NOISE_BLOCK * NOISE_BLOCK].reshape(-1, NOISE_BLOCK)
        level = float(np.percentile(np.sqrt(np.mean(blocks**2, axis=1)), 10))
    else:
        level = float(1.4826 * np.median(np.abs(bend)))
    return max(level / np.sqrt(6.0), (step_of(samples) if step is None else step) / np.sqrt(12.0))


def step_of(samples: NDArray[np.float64]) -> float:
    """Converter step: the smallest change between neighbours that is more than rounding; 0 if constant."""
    change = np.abs(np.diff(samples[: 1 << 16]))
    floor = 1e-9 * float(np.max(np.abs(samples), initial=0.0))
    change = change[change > floor]
    return float(change.min()) if change.size else 0.0


def find_pulse(force: NDArray[np.float64], peak: int) -> Pulse:
    """Bounds, width and polarity of the pulse whose peak is at sample `peak`.

    Parameters
    ----------
    force : ndarray, (n_samples,)
    peak : int
        Sample of the peak within `force`.
    """
    baseline = float(np.median(force))
    sign = 1 if force[peak] >= baseline else -1
    height = float(sign * (force[peak] - baseline))
    level = max(0.02 * height, 5 * noise_of(force))

    def edge(step: int, fraction: float) -> float:
        """Distance from the peak at which the pulse first falls below `fraction`, samples."""
        above, distance = height, 0
        while 0 <= peak + step * (distance + 1) < force.size:
            below = sign * (force[peak + step * (distance + 1)] - baseline)
            if below < fraction:
                return distance + float((above - fraction) / max(above - below, 1e-300))
            above, distance = below, distance + 1
        return float(distance)

    width = edge(1, 0.5 * height) + edge(-1, 0.5 * height)
    return Pulse(
        peak=peak,
        start=max(0, peak - int(np.ceil(edge(-1, level)))),
        stop=min(force.size, peak + int(np.ceil(edge(1, level))) + 1),
        width=max(float(width), 1.0),
        sign=sign,
        baseline=baseline,
        height=height,
    )


def find_second_impact(
    force: NDArray[np.float64], pulse: Pulse, sample_rate_hz: float, limit: float
) -> SecondImpact:
    """Search a second impact, separate from the main pulse or hidden in its flank.

    The pulse of a single blow is log-concave (half-sine, haversine, Gaussian, and whatever a linear
    filter with a log-concave response makes of them): between its peak and any later sample, the
    logarithm of the force never lies below the chord. A second blow lifts a later stretch and so opens a
    valley under the least log-concave curve above the force. That sees a bump tens of milliseconds away and a
    mere shoulder alike, without a template of the pulse.

    What stays hidden is a second pulse under the first whose sum is log-concave again, e.g. two Gaussians
    less than about three standard deviations apart: no shape tells it from one slightly skewed blow.

    Before that, (1) the droop of an AC-coupled amplifier is undone, f = y + a·∫y dt, with a from the
    samples after the pulse; (2) a Gaussian of 0.1 pulse widths, at least 1.2 samples, takes away the
    anti-alias filter's ringing, which would make bumps of pulses only a sample wide; (3) a bump counts
    by how much it rises above the deepest trough about it, so that ringing, which swings both ways, cancels.

    Parameters
    ----------
    force : ndarray, (n_samples,)
    pulse : Pulse
    sample_rate_hz : float
    limit : float
        Ratio from which on a bump is looked at.

    Returns
    -------
    SecondImpact
        The strongest, before or after the main pulse.
    """
    sigma = max(1.2, 0.1 * pulse.width)
    reach = max(int(HORIZON_S * sample_rate_hz), 30)
    raw = pulse.sign * (force - pulse.baseline)
    raw = _undo_droop(raw, pulse, reach)
    smooth = gaussian_filter1d(raw, sigma, mode="constant", truncate=5.0)
    lo, hi = max(0, pulse.peak - 3), min(force.size, pulse.peak + 4)
    peak = lo + int(np.argmax(smooth[lo:hi]))
    scaled = smooth / max(float(smooth[peak]), 1e-300)
    noise = noise_of(force) / pulse.height / np.sqrt(2 * np.sqrt(np.pi) * sigma)
    level = max(limit, 6 * noise)
    sooner = max(MINIMUM_DELAY_S * sample_rate_hz, 2 * sigma, 3.0)
    after = _bump(scaled[peak:], level, sooner, reach, pulse.width + sigma)
    before = _bump(scaled[peak::-1], level, sooner, reach, pulse.width + sigma)
    if before[0] > after[0]:
        return SecondImpact(before[0], -before[1] / sample_rate_hz)
    return SecondImpact(after[0], after[1] / sample_rate_hz)


def _undo_droop(raw: NDArray[np.float64], pulse: Pulse, reach: int) -> NDArray[np.float64]:
    """Force before the amplifier's first-order high-pass, as far as the samples after the pulse show it."""
    stop = min(raw.size, pulse.stop + reach)
    begin = min(pulse.stop + int(pulse.width), stop)
    if stop - begin < 16:
        return raw
    area = np.cumsum(raw[pulse.start : stop])
    tail, held = raw[begin:stop], area[begin - pulse.start :]
    droop = float(np.median(-tail / np.where(held > 0, held, np.inf)))
    if droop <= 0:
        return raw
    restored = raw.copy()
    restored[pulse.start : stop] += droop * area
    return restored


def _bump(
    scaled: NDArray[np.float64], level: float, sooner: float, reach: int, width: float
) -> tuple[float, float]:
    """Ratio and distance (samples) of the strongest bump in a force that starts at its peak of 1."""
    near = scaled[:reach]
    best = (0.0, 0.0)
    candidates = np.flatnonzero(near >= 0.5 * level)
    if candidates.size > 1:
        hull = _hull(candidates, np.log(near[candidates]))
        cover = np.exp(np.interp(np.arange(near.size), candidates[hull], np.log(near[candidates[hull]])))
        gap = np.where(np.arange(near.size) <= candidates[hull[-1]], cover - near, 0.0)
        for left, right in zip(candidates[hull][:-1], candidates[hull][1:], strict=True):
            if right < sooner or right - left < 2 or gap[left:right].max() < VALLEY:
                continue
            best = max(best, _rise(near, int(right), width))
            bottom = left + int(np.argmax(gap[left:right]))
            if width >= RESOLVED and gap[bottom] > DEEP and 0.5 * sooner <= bottom < 2 * width:
                # A shoulder has no top of its own: its height is the force where the valley is deepest.
                trough = float(near[bottom : bottom + int(4 * width)].min())
                best = max(
                    best, (float(min(near[bottom], gap[bottom])) + 2 * min(0.0, trough), float(bottom))
                )
    if scaled.size > reach:
        best = max(best, _rise(scaled, reach, width))
    return best if best[0] > 0 else (0.0, 0.0)


def _rise(scaled: NDArray[np.float64], begin: int, width: float) -> tuple[float, float]:
    """Height of the largest bump from `begin` on, less the deepest trough about it; and its place.

    A bump clear of the main pulse must also be a pulse: it counts only by its rise over the levels that
    lie a few pulse widths before and after it, so that drift is none.
    """
    at = begin + int(np.argmax(scaled[begin:]))
    reach = int(4 * width) + 2
    left, right = scaled[max(0, at - reach) : at + 1], scaled[at : at + reach + 1]
    height = float(scaled[at] + min(0.0, left.min(), right.min()))
    if at > 2 * reach:
        height = min(height, float(scaled[at] - max(left.min(), right.min())))
    return height, float(at)


def _hull(x: NDArray[np.int64], y: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the upper concave hull of points in order of x."""
    kept: list[int] = []
    for i in range(x.size):
        while len(kept) > 1:
            a, b = kept[-2], kept[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                break
            kept.pop()
        kept.append(i)
    return np.asarray(kept, dtype=np.int64)
