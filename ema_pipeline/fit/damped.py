"""Modes of a damped system in the neighbourhood of a point, to first order: without solving it anew.

In the modal coordinates of the undamped system, scaled by the square root of its mass matrix, the changes are
H' = K' - ½(M'Λ + ΛM'), alike for viscous and structural damping; the modal damping ratio acts on √H, whose change has
the entries H'_ij/(ω_i + ω_j). Poles and modes of the state matrix follow from its left and right eigenvectors.

References
----------
R. B. Nelson, AIAA J. 14, 1976, 1201-1205; R. L. Fox, M. P. Kapoor, AIAA J. 6, 1968, 2426-2429 (modal expansion).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import Matrices, Modes, modal_basis
from ema_pipeline.fit.matrices import Derivatives

_EQUAL = 1e-5


def neighbouring_modes(m: Matrices, by: Derivatives, step: float) -> Modes:
    """Modes at a point and one step along each coordinate from there.

    Parameters
    ----------
    m : Matrices
        At the point: a batch of one.
    by : Derivatives
        There, by P coordinates.
    step : float

    Returns
    -------
    Modes
        A batch of 1 + P. Modes that coincide are not mixed.
    """
    basis = modal_basis(m)
    phi, values = basis.shapes[0], basis.eigenvalues[0]
    omega = np.sqrt(np.maximum(values, 0.0))
    n, ratio = omega.size, float(m.modal_damping_ratio[0])
    viscous = phi.T @ m.damping[0] @ phi
    elastic = np.diag(values) + 1j * (phi.T @ m.structural[0] @ phi)
    scale = max(float(omega[-1]), 1.0)
    state = np.zeros((2 * n, 2 * n), dtype=complex)
    state[:n, n:] = scale * np.eye(n)
    state[n:, :n] = -elastic / scale
    state[n:, n:] = -viscous - np.diag(2 * ratio * omega)
    poles, right = np.linalg.eig(state)
    left = np.linalg.inv(right)

    mass = phi.T @ by.mass @ phi
    stiffer = _scaled(phi.T @ by.stiffness @ phi, mass, np.diag(values))
    both = np.maximum(omega[:, None] + omega[None, :], 1e-9 * scale)
    damped = _scaled(phi.T @ by.damping @ phi, mass, viscous) + 2 * ratio * stiffer / both
    damped = damped + 2 * by.modal_damping_ratio[:, None, None] * np.diag(omega)
    lossy = _scaled(phi.T @ by.structural @ phi, mass, elastic.imag)

    upper = np.argsort(-poles.imag, kind="stable")[:n]
    upper = upper[np.argsort(np.abs(poles[upper]), kind="stable")]
    chosen = right[:, upper]
    change = -((stiffer + 1j * lossy) / scale) @ chosen[:n] - damped @ chosen[n:]
    coupling = left[:, n:] @ change
    gap = poles[upper][None, :] - poles[:, None]
    inverse = gap.conj() / (np.abs(gap) ** 2 + (_EQUAL * np.abs(poles[upper])) ** 2 + 1e-300)
    moved = right[:n] @ (coupling * inverse)
    drift = coupling[:, upper, np.arange(n)]

    s = np.vstack([poles[upper], poles[upper] + step * drift])
    modal = np.concatenate([chosen[None, :n], chosen[:n] + step * moved])
    modal = modal / np.maximum(np.linalg.norm(modal, axis=1, keepdims=True), 1e-300)
    shapes = modal.copy()
    shapes[1:] -= 0.5 * step * (mass @ modal[1:])
    size = np.abs(s)
    return Modes(
        omega=size,
        damping_ratio=-s.real / np.maximum(size, 1e-300),
        shapes=phi @ shapes,
        directions=basis.directions[0] @ modal,
    )


def _scaled(
    change: NDArray[np.float64], mass: NDArray[np.float64], matrix: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Change of a matrix in coordinates that are scaled by the square root of the mass matrix."""
    return np.asarray(change - 0.5 * (mass @ matrix + matrix @ mass))
