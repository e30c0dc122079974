"""What the fit of a mode to the spectrum of a single hit reads of a motion that is no plain decay.

The fit is that of `levels.differences`: derivatives of the mode's line by its pole and by the logarithm of its size,
and smooth terms. It is linear, so what it reads of a motion is a weighted sum over instants, or over exponents.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.levels.differences import smooth_terms

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

LAST = 8.0
"""Last instant that counts, in units of 1/2σ: 99.7 % of the weight is before it."""
_FINE = 400
"""Instants at which the weight of a mode's fit is found before it is put together to few."""


def momentary_weights(instants: Real, pole: complex, lines_hz: Real) -> Complex:
    """Weight of the momentary change of a pole at each instant in the pole and in ln of the size that are read, (2, t).

    A change at the instant τ alone adds exp(λt) from then on.
    """
    s = np.asarray(2j * np.pi * lines_hz - pole, np.complex128)
    fine = np.linspace(0.0, 0.5 * LAST / -pole.real, _FINE)
    weight = _reading(s) @ (np.exp(-np.outer(s, fine)) / s[:, None]) * (fine[1] - fine[0])
    place = np.interp(fine, instants, np.arange(len(instants), dtype=float))
    low = np.minimum(place.astype(int), len(instants) - 2)
    share = place - low
    total = np.zeros((2, len(instants)), complex)
    for row in range(2):
        np.add.at(total[row], low, (1 - share) * weight[row])
        np.add.at(total[row], low + 1, share * weight[row])
    return total


def drive_gains(exponents: Complex, pole: complex, lines_hz: Real) -> Complex:
    """Change of the pole and of ln of the size that are read of a mode of unit envelope, (2, …).

    Where its envelope is driven from the blow on by exp(μt) per second, less its own exp(λt): that adds
    1/((jω - μ)(jω - λ)).

    Parameters
    ----------
    exponents : complex ndarray, (…)
        μ, 1/s.
    pole : complex
        λ, 1/s.
    lines_hz : ndarray, (n_lines,)
    """
    omega = np.asarray(2j * np.pi * lines_hz, np.complex128)
    reads = _reading(omega - pole) / (omega - pole)
    gains = reads @ (1 / (omega[:, None] - exponents.ravel()))
    return np.asarray(gains.reshape(2, *exponents.shape))


def _reading(s: Complex) -> Complex:
    """Change of the pole and of ln of the size that the fit reads of every line, (2, n_lines)."""
    columns = np.stack([s**-2, 1 / s, *smooth_terms(len(s))], axis=1)
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(np.linalg.pinv(columns / size)[:2] / size[:2, None])
