"""What an analyser's anti-alias filter leaves of a signal."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

_EDGE = 32
"""Samples over which a record is mirrored beyond its end, so that the filter meets no step."""


def anti_alias(frequency_hz: NDArray[np.float64], sample_rate_hz: float) -> NDArray[np.float64]:
    """Gain of the analyser's filter: 1 up to rate/2.56, a cosine flank, 0 at half the rate (no phase)."""
    low, high = sample_rate_hz / 2.56, sample_rate_hz / 2
    flank = np.clip((frequency_hz - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.cos(0.5 * np.pi * flank) ** 2)


def band_limited(fine: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
    """Signals (..., n_steps) at `substeps` steps per sample, without what an analyser's filter takes off.

    A blow between teeth is shorter than a sample: what is sampled without a filter has the area of the spike wrong,
    and with it the motion at low frequencies.
    """
    if substeps == 1 or not fine.size:
        return fine
    n, edge = fine.shape[-1], min(_EDGE * substeps, fine.shape[-1] - 1)
    length = scipy.fft.next_fast_len(n + 2 * edge, real=True)
    longer = np.zeros((*fine.shape[:-1], length))
    longer[..., :n] = fine
    taper = np.cos(0.5 * np.pi * np.arange(1, edge + 1) / edge) ** 2
    longer[..., n : n + edge] = fine[..., -2 : -edge - 2 : -1] * taper
    gain = anti_alias(scipy.fft.rfftfreq(length, 1 / substeps), 1.0)
    return np.asarray(scipy.fft.irfft(scipy.fft.rfft(longer) * gain, length)[..., :n])
