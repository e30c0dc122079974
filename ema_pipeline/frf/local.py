"""Spectra of several forces at once without leakage: the transient of a whole record is taken out line by line.

A record that is cut into blocks leaks at every cut. With several forces that hurts twice, for what one of them leaks is
noise to the others, and largest at the very modes that they share. Over a few neighbouring lines of the whole record
the FRFs and the transient are polynomials, so that the transient and all slopes can be taken out of forces and
responses. Every line that is left counts as an average.

References
----------
R. Pintelon, J. Schoukens, G. Vandersteen, K. Barbe, Estimation of nonparametric noise and FRF models for multivariable
systems, part I, *Mechanical Systems and Signal Processing* 24 (2010) 573-595.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.frf.spectra import Spectra
from ema_pipeline.ingest.driven import DrivenRecord

DEGREE = 2
"""Of the polynomials: odd degrees add nothing to the value at the centre."""
FREEDOM = 12
"""Degrees of freedom that the noise is estimated with."""
_AT_ONCE = 1024
"""Lines at once."""


def reach(n_forces: int) -> int:
    """Lines to either side that an estimate sees."""
    return (_nuisance(n_forces) + n_forces + FREEDOM) // 2


def _nuisance(n_forces: int) -> int:
    """Columns of the transient and of the slopes of the FRFs."""
    return DEGREE + 1 + DEGREE * n_forces


def long_enough(records: Sequence[DrivenRecord], lines: int) -> bool:
    """True for records of one length that leave at least so many lines."""
    counts = {r.n_samples - r.transient for r in records}
    return len(counts) == 1 and counts.pop() // 2 >= lines * reach(len(records[0].forces))


def local_spectra(records: Sequence[DrivenRecord]) -> tuple[Spectra, NDArray[np.float64]]:
    """Sums over neighbouring lines, and the frequencies of their centres, Hz.

    Parameters
    ----------
    records : sequence of DrivenRecord
        Of one length, without periods.

    Returns
    -------
    spectra : Spectra
    frequency_hz : ndarray, (n_centres,)
        From 0, equally spaced, `reach` lines apart.
    """
    first = records[0]
    n_in, n_out = len(first.forces), len(first.channels)
    count, half = first.n_samples - first.transient, reach(n_in)
    last = count // 2
    centres = np.arange(0, last + 1, half)
    total = Spectra.none(n_in, n_out, len(centres))
    for record in records:
        f, y = (_lines(s[:, record.transient :]) for s in (record.force, record.responses))
        for start in range(0, len(centres), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            near = np.clip(centres[part] - half, 1, last - 2 * half)[:, None] + np.arange(2 * half + 1)
            away = (near - centres[part][:, None]) / half
            forces, responses = f[near], y[near]  # (n_centres, n_near, n_channels)
            powers = away[..., None] ** np.arange(DEGREE + 1)
            slopes = powers[..., 1:, None] * forces[:, :, None, :]
            known = np.concatenate([powers, slopes.reshape(*away.shape, -1)], axis=-1)
            q = np.linalg.qr(known)[0]
            forces, responses = (s - q @ (q.conj().swapaxes(1, 2) @ s) for s in (forces, responses))
            total.forces[part] += np.einsum("cni,cnj->cij", forces, forces.conj())
            total.cross[part] += np.einsum("cno,cnj->coj", responses, forces.conj())
            total.responses[part] += np.sum(np.abs(responses) ** 2, axis=1)
        total.count += 2 * half + 1 - _nuisance(n_in)
    return total, centres * first.sample_rate_hz / count


def _lines(signals: NDArray[np.float64]) -> NDArray[np.complex128]:
    return np.ascontiguousarray(rfft(signals - signals.mean(axis=1, keepdims=True), axis=1).T)
