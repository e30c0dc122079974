"""Polyreference LSCF (PolyMAX): poles, participation factors and shapes of all orders.

References
----------
Peeters, Van der Auweraer, Guillaume & Leuridan, "The PolyMAX frequency-domain method: a new standard for
modal parameter estimation?", Shock and Vibration 11, 2004.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.normal_equations import (
    Fraction,
    NormalEquations,
    fractions,
    normal_equations,
    numerator,
)
from ema_pipeline.modal.poles import PoleSet

MAX_DAMPING_RATIO = 0.3
"""Poles above are no modes that FRFs could show as peaks."""


def polyreference_poles(
    omega: NDArray[np.float64],
    frf: NDArray[np.complex128],
    weight: NDArray[np.float64],
    orders: list[int],
    row_scale: NDArray[np.float64] | None = None,
) -> PoleSet:
    """Poles of all orders; the band is mapped onto the half circle.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
        rad/s, equally spaced.
    frf : complex ndarray, (n_rows, n_references, n_lines)
        Noise of all rows alike, once divided by `row_scale`.
    weight : ndarray, (n_lines,)
        Squared weight of each line.
    orders : list of int
        Polynomial orders.
    row_scale : ndarray, (n_rows,), optional

    Returns
    -------
    PoleSet
        Stable poles inside the band.
    """
    orders = sorted(orders)
    equations = normal_equations(frf, weight, orders[-1], 0, len(omega) - 1, row_scale)
    parts = [_poles_of(fraction, equations, omega) for fraction in fractions(equations, orders)]
    return PoleSet(
        order=np.concatenate([np.full(len(p), n) for n, (p, _, _) in zip(orders, parts, strict=True)]),
        pole=np.concatenate([p for p, _, _ in parts]),
        shape=np.concatenate([s for _, s, _ in parts]),
        participation=np.concatenate([w for _, _, w in parts]),
        orders=tuple(orders),
    )


def _poles_of(
    fraction: Fraction, equations: NormalEquations, omega: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    n, r = fraction.order, fraction.denominator.shape[1]
    companion = np.eye(n * r, k=r)
    companion[-r:] = -fraction.denominator[:-1].transpose(1, 0, 2).reshape(r, n * r)
    z = np.linalg.eigvals(companion)
    z = z[(z.imag < 0) & (np.abs(z) > 0)]
    step = np.pi / (omega[-1] - omega[0])
    pole = 1j * omega[0] - np.log(z) / step
    keep = (pole.real < 0) & (pole.real > -MAX_DAMPING_RATIO * np.abs(pole))
    z, pole = z[keep], pole[keep]
    powers = z[:, None] ** np.arange(n + 1)
    a = np.einsum("pk,kij->pij", powers, fraction.denominator)
    u, _, vh = np.linalg.svd(a)
    right = vh[:, -1].conj()
    left = u[:, :, -1].conj()  # row vector w with w A = 0
    b = np.einsum("pk,oki->poi", powers, numerator(equations, fraction), optimize=True)
    shape = np.einsum("poi,pi->po", b, right)
    return pole, shape, left
