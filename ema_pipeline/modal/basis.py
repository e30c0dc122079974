"""Functions of frequency that modes and out-of-band modes add to an accelerance.

A mode with pole s adds Q/(jω − s) + Q*/(jω − s*), with Q = s²A where A is its receptance residue; the
difference to −ω²(A/(jω − s) + …) is a constant, which the residual terms hold. A record of finite length T
cuts the response off: the transform of the cut tail is known in closed form, so that the basis

    u(ω; s) = (1 − exp((s − jω)(T − t₀))) / (jω − s)

is exact for records that have not decayed, with t₀ the time of the hit within the record.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis_kernel import columns_of_poles

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


def pole_functions(omega: Real, poles: Complex, rest_s: float) -> tuple[Complex, Complex]:
    """u(ω; s) and its derivative by s.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
        rad/s.
    poles : complex ndarray, (n_poles,)
        rad/s.
    rest_s : float
        Time from the hit to the end of the record, s; ``inf`` for a decayed record.

    Returns
    -------
    u, du : complex ndarray, (n_poles, n_lines)
    """
    inverse = 1.0 / (1j * omega - poles[:, None])
    if not np.isfinite(rest_s):
        return inverse, inverse**2
    tail = _tail(omega, poles, rest_s)
    u = (1.0 - tail) * inverse
    return u, u * inverse - rest_s * tail * inverse


def pole_values(omega: Real, poles: Complex, rest_s: float) -> Complex:
    """The first of `pole_functions` alone."""
    u = 1j * omega - poles[:, None]
    np.divide(1.0, u, out=u)
    if np.isfinite(rest_s):
        u *= 1.0 - _tail(omega, poles, rest_s)
    return np.asarray(u)


def _tail(omega: Real, poles: Complex, rest_s: float) -> Complex:
    """exp((s - jω)·rest): as a product, because an exponential of every line and pole costs ten times as much."""
    return np.asarray(_left(poles, rest_s)[:, None] * np.exp(-1j * omega * rest_s))


def real_columns(omega: Real, poles: Complex, rest_s: float) -> tuple[Complex, Complex]:
    """Columns that real and imaginary parts of a residue multiply, and the same for du/ds.

    Returns
    -------
    columns, derivatives : complex ndarray, (2·n_poles, n_lines)
        Rows 2r and 2r+1 belong to the real and imaginary part of mode r: Q gives Re Q times row 2r plus
        Im Q times row 2r+1.
    """
    columns, derivatives = np.empty((2, 2 * len(poles), len(omega)), dtype=np.complex128)
    _fill(omega, poles, rest_s, columns, derivatives)
    return columns, derivatives


def mode_columns(omega: Real, poles: Complex, rest_s: float) -> Complex:
    """The columns of `real_columns` alone, at two thirds of the cost."""
    columns = np.empty((2 * len(poles), len(omega)), dtype=np.complex128)
    _fill(omega, poles, rest_s, columns, columns[:0])
    return columns


def _fill(omega: Real, poles: Complex, rest_s: float, columns: Complex, derivatives: Complex) -> None:
    if np.isfinite(rest_s):
        left, turn = _left(poles, rest_s), np.exp(-1j * omega * rest_s)
    else:
        rest_s, left, turn = 0.0, np.zeros_like(poles), np.zeros(len(omega), dtype=np.complex128)
    flat = np.ascontiguousarray(omega), np.ascontiguousarray(poles)
    columns_of_poles(*flat, rest_s, left, turn, columns, derivatives)


def _left(poles: Complex, rest_s: float) -> Complex:
    """exp(s·rest), bounded for poles that grow."""
    return np.asarray(np.exp(np.minimum(poles.real * rest_s, 30.0) + 1j * poles.imag * rest_s))


EDGE = 0.12
"""Distance of the two stand-in poles from the edges of the band, as a share of its width."""

EDGE_DECAY = 0.06
"""Their decay, as a share of the width of the band."""


def residual_columns(omega: Real, cut_s: float | None = None) -> Complex:
    """Terms of modes outside the band, each with a complex coefficient per FRF.

    A mass line (constant) and a stiffness line (ω²) stand for what is far away; one pole beyond either edge
    for modes that lie close to the band, whose tails no polynomial of low order follows.

    Where responses are cut off while they ring, all that still moves stops at once. What that adds beside the modes'
    own functions (the width of the pulse and its time between samples, modes outside the band, derivatives of
    velocities and displacements) is a straight line over frequency, turned by the time of the end, which at FFT
    lines is that of the hit.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
    cut_s : float, optional
        Time before the hit in records that end while the responses ring; None where they have decayed.

    Returns
    -------
    ndarray, (8 or 12, n_lines)
        Each term times 1 and j, scaled to order 1 in the band.
    """
    width = omega[-1] - omega[0]
    one = np.ones_like(omega)
    square = (omega / omega[-1]) ** 2
    below = 1.0 / (1j * (omega - omega[0] + EDGE * width) / width + EDGE_DECAY)
    above = 1.0 / (1j * (omega - omega[-1] - EDGE * width) / width + EDGE_DECAY)
    terms = np.stack([one, square - square.mean(), below, above])
    if cut_s is not None:
        terms = np.concatenate([terms, np.exp(1j * omega * cut_s) * np.stack([one, omega / omega[-1]])])
    return np.concatenate([terms, 1j * terms])
