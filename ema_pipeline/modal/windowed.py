"""Noise under an exponential window: neighbouring lines share it, and it decays as modes do.

White noise n(t) under the window exp(-σt) has a spectrum whose lines k and l correlate by

    c[k - l] = Σ exp(-2σt) exp(-j(k - l)Δω t) / Σ exp(-2σt) = 1 / (1 + j(k - l)Δω / 2σ) ,

the sums taken over the whole record. A fit that took the lines for independent would find modes in the noise,
and think its own errors too small.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, next_fast_len

from ema_pipeline.modal.data import FitData

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


def power_of(factors: Complex, data: FitData) -> Real:
    """Re(B C Bᴴ) for factors B (n, n_lines) of noise of variance 1 with the correlation C between lines.

    Parameters
    ----------
    factors : complex ndarray, (n, n_lines)
    data : FitData
        Of which the line spacing and the decay rate of the window are used.

    Returns
    -------
    ndarray, (n, n)
    """
    if data.window_rad_s <= 0:
        parts = np.ascontiguousarray(factors).view(np.float64)  # real and imaginary parts side by side
        return np.asarray(parts @ parts.T)
    n_lines = factors.shape[1]
    step = (data.omega[1] - data.omega[0]) / (2 * data.window_rad_s)
    kernel = 1 / (1 + 1j * step * np.arange(n_lines))
    n = next_fast_len(2 * n_lines)
    padded = np.zeros(n, dtype=np.complex128)
    padded[:n_lines] = kernel
    padded[n - n_lines + 1 :] = kernel[:0:-1].conj()
    spread = ifft(fft(factors.conj(), n, axis=1) * fft(padded), axis=1)[:, :n_lines]
    return np.asarray((factors @ spread.T).real)


def likeness(decay_rad_s: Real, data: FitData) -> Real:
    """How many times more power noise under the window has in the form of a decay than white noise would.

    Parameters
    ----------
    decay_rad_s : ndarray, (n_modes,)
        Decay rates as the FRFs show them, the window's share included.
    data : FitData

    Returns
    -------
    ndarray, (n_modes,)
        1 without a window; up to 2σT for decays much faster than the window's.
    """
    if data.window_rad_s <= 0:
        return np.ones(len(decay_rad_s))
    sigma, record_s = data.window_rad_s, 2 * np.pi / (data.omega[1] - data.omega[0])
    share = decay_rad_s / (decay_rad_s + sigma)
    return np.asarray(np.maximum(1.0, share * 2 * sigma * record_s / -np.expm1(-2 * sigma * record_s)))
