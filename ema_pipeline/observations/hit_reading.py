"""What the fit of a mode to the spectrum of a single hit reads of a motion that is no plain decay.

The fit is that of `levels.differences`: derivatives of the mode's line by its pole and by the logarithm of its size,
and smooth terms. It is linear, so what it reads of a motion is a weighted sum over instants, or over exponents.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ema_pipeline.levels.differences import smooth_terms

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

LAST = 8.0
"""Last instant that counts, in units of 1/2σ: 99.7 % of the weight is before it."""
_FINE = 400
"""Instants at which the weight of a mode's fit is found before it is put together to few."""
_STEPS, _LEFT = 3, 0.1
"""Steps of the fit that reads a mode anew about what it found, and least share of its size that a step may leave."""
_STILL = 1e-300
_WEIGHED = 2
"""Times that lines are weighed by what the fit with the last weights leaves over."""
_NOISE = 1e-3
"""1 σ of what measured lines hold beside, over the largest response."""
_BLURRED = 15
"""Share of the lines, one in so many, over which what is left over is averaged."""


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


def read_of_drive(
    s: Complex, drive: Complex, displacement: Complex, decay: float, weight: Real
) -> tuple[Complex, Complex]:
    """Change of the pole, 1/s, and of ln of the size that a fit reads of driven lines, each (h,).

    Parameters
    ----------
    s : complex ndarray, (n_lines,)
        jω - λ.
    drive : complex ndarray, (h, n_lines)
        Spectrum of what drives the envelope.
    displacement : complex ndarray, (h,)
        Size that was read with the drive.
    decay : float
    weight : ndarray, (n_lines,)
        Of each line, over one constant.
    """
    smooth, driven = _smooth(weight), _driven(s, drive, displacement)
    pole, grown = _step(s[None], driven, smooth, weight)
    begun = 1.0 - grown  # what was there without the drive, over what was read
    lines = begun[:, None] / s + driven
    pole = np.where(np.abs(pole) < decay, pole, pole / np.maximum(np.abs(pole), _STILL) * decay)
    now = np.ones(len(pole), complex)
    for _ in range(_STEPS):
        apart = s - pole[:, None]
        moved, more = _step(apart, lines - now[:, None] / apart, smooth, weight)
        near = (np.abs(moved) <= decay) & (np.abs(now + more) > _LEFT)
        pole, now = (
            pole + np.where(near, moved / np.where(near, now, 1.0), 0.0),
            now + np.where(near, more, 0.0),
        )
    return pole, now - begun


def line_weights(s: Complex, drive: Complex, displacement: Complex) -> Real:
    """Weights of the lines in the fit of a sheet's hits, up to one factor, (n_lines,).

    A fit of single hits weighs lines by one over the noise that it finds. What friction cuts off a decay is no single
    pole's: it is left over, most where the response is large, and is taken for noise there. Without these weights
    friction of 0.1 N came out as 0.05 N on a simulated rig; with one over the response in any case, modes that it
    hardly moves were read half a decay rate off.

    Parameters
    ----------
    s : complex ndarray, (n_lines,)
        jω - λ.
    drive : complex ndarray, (h, n_lines)
    displacement : complex ndarray, (h,)
        See `read_of_drive`; of the hits that tell of the mode.
    """
    weight, driven = np.ones(len(s)), _driven(s, drive, displacement)
    for _ in range(_WEIGHED if len(driven) else 0):
        smooth = _smooth(weight)
        pole, size = _step(s[None], driven, smooth, weight)
        left = weight * (driven - pole[:, None] / s**2 - size[:, None] / s)
        left = (left - (left @ smooth.T) @ smooth) / weight
        power = uniform_filter1d(
            np.mean(np.abs(left) ** 2, axis=0), max(len(s) // _BLURRED, 3), mode="nearest"
        )
        weight = 1 / np.sqrt(power + (_NOISE / np.abs(s).min()) ** 2)
        weight /= weight.max()
    return weight


def _driven(s: Complex, drive: Complex, displacement: Complex) -> Complex:
    """Driven lines over the size of their mode; nothing where that does not move."""
    still = np.abs(displacement) < _STILL
    size = np.where(still, 1.0, displacement)
    return np.asarray(np.where(still[:, None], 0.0, drive) / s / size[:, None])


def _smooth(weight: Real) -> Complex:
    """Weighted smooth terms, orthonormal, (n_terms, n_lines)."""
    return np.asarray(np.linalg.qr((weight * smooth_terms(len(weight))).T)[0].T, np.complex128)


def _step(s: Complex, lines: Complex, smooth: Complex, weight: Real) -> tuple[Complex, Complex]:
    """Coefficients of 1/s² and 1/s in weighted lines, smooth terms beside them, each (h,)."""
    second = weight / s
    one, two, rest = (c - (c @ smooth.T) @ smooth for c in (second / s, second, weight * lines))
    a, d = (np.sum(c.real**2 + c.imag**2, axis=1) for c in (one, two))
    b = np.sum(one.conj() * two, axis=1)
    right = [np.sum(c.conj() * rest, axis=1) for c in (one, two)]
    determinant = a * d - np.abs(b) ** 2
    return (d * right[0] - b * right[1]) / determinant, (a * right[1] - b.conj() * right[0]) / determinant
