"""The analyser's anti-alias filter, and forces at the steps between samples."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray


def anti_alias(frequency_hz: NDArray[np.float64], sample_rate_hz: float) -> NDArray[np.float64]:
    """Gain of the analyser's filter: 1 up to rate/2.56, a cosine flank, 0 at half the rate (no phase)."""
    low, high = sample_rate_hz / 2.56, sample_rate_hz / 2
    flank = np.clip((frequency_hz - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.cos(0.5 * np.pi * flank) ** 2)


def straightened(force: NDArray[np.float64], substeps: int) -> NDArray[np.float64]:
    """Band-limited forces at steps, whose straight connections act on slow motions as the forces do.

    Parameters
    ----------
    force : ndarray, (n_forces, n_samples)
        N.
    substeps : int
        Steps per sample.

    Returns
    -------
    ndarray, (n_forces, substeps·(n_samples - 1) + 1)
        Straight lines between steps weaken what happens at frequency f by sinc²(f·step), which is taken back here.
    """
    n = force.shape[1]
    length = scipy.fft.next_fast_len(n + 64, real=True)
    padded = np.pad(force, ((0, 0), (0, length - n)))
    spectrum = scipy.fft.rfft(padded, axis=1)
    ramp = np.sinc(np.arange(spectrum.shape[1]) / (length * substeps)) ** 2
    fine = scipy.fft.irfft(spectrum / ramp * substeps, length * substeps, axis=1)
    return np.asarray(fine[:, : (n - 1) * substeps + 1])
