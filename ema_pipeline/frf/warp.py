"""Spectra of a record at frequencies that lie off the lines of its discrete Fourier transform.

A structure whose frequencies have all risen by the factor 1 + d answers at ω(1 + d) as it answered at ω before.
Force and response read at ω(1 + d) therefore give the FRF of the structure as it was. The transform at any
frequencies is the transform of the record, twice as long and divided by the transform of a short kernel,
interpolated with that kernel.

References
----------
Fessler, J. A. & Sutton, B. P., "Nonuniform fast Fourier transforms using min-max interpolation",
IEEE Trans. Signal Processing 51, 2003 (Kaiser-Bessel kernel).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.special
from numpy.typing import NDArray
from scipy.fft import rfft

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

TAPS = 10
"""Lines of the longer transform that the kernel covers: an error of 1e-9 of the largest line."""

SHAPE = np.pi * np.sqrt((TAPS * 0.75) ** 2 - 0.8)
"""Shape parameter of the Kaiser-Bessel kernel for a transform of twice the length."""


class WarpedTransform:
    """Transform of real records at the lines of their own transform, each moved by a small factor.

    Parameters
    ----------
    n_samples : int
    shift : ndarray, (n_lines,)
        Line k is read at k·(1 + shift[k]) lines; n_lines = n_samples // 2 + 1.
    """

    def __init__(self, n_samples: int, shift: Real) -> None:
        self._n, self._long = n_samples, 2 * n_samples
        place = 2.0 * np.arange(len(shift)) * (1.0 + shift)
        first = np.ceil(place - TAPS / 2).astype(np.int64)
        taps = first[:, None] + np.arange(TAPS)
        values = _kernel(place[:, None] - taps)
        # lines below 0 and above the Nyquist frequency are the conjugates of those on the other side
        beyond = taps > n_samples
        folded = np.abs(np.where(beyond, self._long - taps, taps))
        mirrored = (taps < 0) | beyond
        rows = np.repeat(np.arange(len(shift)), TAPS)
        size = (len(shift), n_samples + 1)

        def matrix(keep: NDArray[np.bool_]) -> scipy.sparse.csr_matrix:
            chosen = keep.ravel()
            return scipy.sparse.csr_matrix(
                (values.ravel()[chosen], (rows[chosen], folded.ravel()[chosen])), shape=size
            )

        self._direct, edges = matrix(~mirrored), matrix(mirrored)
        self._at_edges = np.flatnonzero(np.diff(edges.indptr))
        self._mirrored = edges[self._at_edges]
        time = np.arange(n_samples) - n_samples // 2
        self._taper = 1.0 / _kernel_transform(time / self._long)
        self._turn = np.exp(-1j * np.pi * place / self._long * 2 * (n_samples // 2))

    def __call__(self, samples: Real) -> Complex:
        """Transform of records along the last axis, (..., n_samples) to (..., n_lines)."""
        flat = np.atleast_2d(samples).reshape(-1, self._n) * self._taper
        padded = np.zeros((len(flat), self._long))
        half = self._n // 2
        padded[:, : self._n - half] = flat[:, half:]
        if half:
            padded[:, -half:] = flat[:, :half]
        # real and imaginary parts side by side, as the matrices are real
        spectrum = np.ascontiguousarray(np.asarray(rfft(padded, axis=-1)).T).view(np.float64)
        moved = (self._direct @ spectrum).view(np.complex128)
        moved[self._at_edges] += (self._mirrored @ spectrum).view(np.complex128).conj()
        out = (moved.T * self._turn).reshape(*samples.shape[:-1], len(self._turn))
        return np.asarray(out)


def _kernel(distance: Real) -> Real:
    """Kaiser-Bessel kernel over lines of the longer transform."""
    inside = np.maximum(1.0 - (2.0 * distance / TAPS) ** 2, 0.0)
    return np.asarray(np.where(np.abs(distance) <= TAPS / 2, scipy.special.i0(SHAPE * np.sqrt(inside)), 0.0))


def _kernel_transform(time: Real) -> Real:
    """Fourier transform of the kernel, `time` in lengths of the longer transform, |time| ≤ 1/4."""
    root = np.sqrt(SHAPE**2 - (np.pi * TAPS * time) ** 2)
    return np.asarray(TAPS * np.sinh(root) / root)
