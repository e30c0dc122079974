"""Windows for hammer tests: about the force pulse, and an exponential one on force and responses alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.pulse import Pulse, find_pulse
from ema_pipeline.ingest.records import HitSamples

AUTO_END = 0.01
"""Value of the automatic exponential window at the end of the record."""

MINIMUM_REST = 8
"""Samples before the pulse that a baseline is taken from."""


def decay_rate(settings: FrfSettings, record_s: float) -> float:
    """Decay rate σ of the exponential window, rad/s; 0 for none."""
    if settings.exponential_window == "none":
        return 0.0
    if settings.exponential_window == "auto":
        return float(-np.log(AUTO_END) / record_s)
    return float(settings.exponential_window)


def force_window(force: NDArray[np.float64], peak: int) -> NDArray[np.float64]:
    """Window of 1 over the pulse, with cosine tapers outside it, 0 beyond.

    Parameters
    ----------
    force : ndarray, (n_samples,)
    peak : int
        Sample of the peak.

    Returns
    -------
    ndarray, (n_samples,)
    """
    return _window_about(find_pulse(force, peak), force.size)


def _window_about(pulse: Pulse, count: int) -> NDArray[np.float64]:
    """`force_window` of a pulse that was found, (count,)."""
    # The anti-alias filter's ringing belongs to the pulse: it shapes force and response alike.
    margin = int(2 * pulse.width) + 8
    taper = 2 * margin
    place = np.arange(count)
    outside = np.maximum(pulse.start - margin - place, place - (pulse.stop - 1 + margin)).clip(0, taper)
    return np.asarray(0.5 * (1 + np.cos(np.pi * outside / taper)))


def pulse_alone(force: NDArray[np.float64], peak: int) -> tuple[int, NDArray[np.float64]]:
    """The force of a blow without what the hammer reads before and after it.

    Parameters
    ----------
    force : ndarray, (n_samples,)
    peak : int
        Sample of the peak.

    Returns
    -------
    first : int
        Sample of the record that it begins at.
    pulse : ndarray
    """
    found = find_pulse(force, peak)
    window = _window_about(found, force.size)
    first, last = np.flatnonzero(window)[[0, -1]]
    cut = slice(int(first), int(last) + 1)
    return int(first), (force[cut] - _offset(force, found.start)) * window[cut]


def _offset(samples: NDArray[np.float64], rest: int) -> NDArray[np.float64]:
    """Mean of the first `rest` samples, or the median of all where these are few; the last axis is kept."""
    if rest >= MINIMUM_REST:
        return np.asarray(samples[..., :rest].mean(axis=-1, keepdims=True))
    return np.asarray(np.median(samples, axis=-1, keepdims=True))


class Windows:
    """The windows of one hit.

    The exponential window exp(-σt) starts at the start of the record, on force and responses alike. Then the
    windowed response is the convolution of the windowed force with exp(-σt) times the impulse response:
    the FRF is exactly that of the structure with σ added to the decay of every pole. Since only the
    ratio counts, the window's value at the blow does not matter.

    Offsets, which a window would smear over the lowest lines, are taken off first: the mean before the pulse
    where at least eight samples lie there, otherwise the median of the record.

    Responses that still ring from the hit before, earlier in the recording, are held at their mean until the blow. What
    rings then starts with the blow, as the response to it does, and changes residues alone: from before the
    blow on it would turn against them over frequency, and poles would be off.

    Parameters
    ----------
    hit : HitSamples
    settings : FrfSettings
    offsets : bool
        True where offsets are taken off without a window too: between the lines of a transform they leak.
    """

    def __init__(self, hit: HitSamples, settings: FrfSettings, *, offsets: bool = False) -> None:
        n = hit.force.size
        decay = decay_rate(settings, n / hit.sample_rate_hz)
        self._decay = np.exp(-decay * np.arange(n) / hit.sample_rate_hz) if decay > 0 else None
        peak = hit.hit.peak - hit.hit.start
        self._shape = force_window(hit.force, peak) if settings.force_window == "auto" else None
        self.active = self._decay is not None or self._shape is not None or offsets
        self._offsets = offsets
        struck_ringing = hit.hit.number > 1 and hit.hit.rings_on
        before = find_pulse(hit.force, peak).start if self.active or struck_ringing else 0
        self._rest = before if self.active else 0
        self._held = before if struck_ringing else 0

    def force(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """The windowed force; the samples themselves without windows."""
        if not self.active:
            return samples
        windowed = samples - _offset(samples, self._rest)
        if self._shape is not None:
            windowed *= self._shape
        return windowed if self._decay is None else windowed * self._decay

    def responses(self, block: NDArray[np.float64]) -> NDArray[np.float64]:
        """The windowed responses (n_channels, n_samples); the block itself where nothing has to be done."""
        if self._held:
            block = block.copy()
            block[:, : self._held] = block[:, : self._held].mean(axis=1, keepdims=True)
        if self._decay is None:
            return block - _offset(block, self._rest) if self._offsets else block
        return np.asarray((block - _offset(block, self._rest)) * self._decay)
