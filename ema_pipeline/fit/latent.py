"""The latent-shape objective: how nearly does the model's equation hold for each measured mode, unpaired.

For measured mode r with frequency ω_r and shape y_r at the sensors S the full shape u is unknown. Its best
guess
minimises ‖(S u - y_r)/σ‖² + ‖W Z_r u‖²/(τ² ω_r⁴ a_r), with Z_r = K - ω_r² M, W the inverse Cholesky factor of
M
and a_r = uᵀMu; the minimum is the mode's cost. No pairing is needed, and degenerate shapes may rotate. In the
model's own modal coordinates q the second term is Σ ((λ_k - ω_r²)/(τ ω_r²))² |q_k|²/a_r: one small ridge
regression.

References
----------
J. L. Beck, L. S. Katafygiotis, "Updating models and their uncertainties", J. Eng. Mech. 124, 1998 (system
modes as
latent variables). G. H. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least
squares
problems whose variables separate", SIAM J. Numer. Anal. 10, 1973; L. Kaufman, BIT 15, 1975 (the Jacobian
used).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.correlate.residuals import Basis, modal_basis
from ema_pipeline.fit.evidence import Dataset


class LatentObjective:
    """Cost of every measured mode of all configurations, and its Gauss-Newton terms.

    Parameters
    ----------
    evidence : sequence of Dataset
    tau_least : float
        Eigenvalue error (relative) that each mode is allowed at least: high at the start of the annealing.
    """

    def __init__(self, evidence: Sequence[Dataset], tau_least: float) -> None:
        self.evidence = evidence
        self.tau = [np.maximum(2 * e.relative_std, tau_least) for e in evidence]

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,)."""
        parts = []
        for e, tau in zip(self.evidence, self.tau, strict=True):
            basis = modal_basis(e.family.at(x[None]))
            if e.has_shapes:
                parts.append(_ridge(e, tau, basis)[1])
            else:
                parts.append(_nearest(e, tau, basis)[1] ** 2)
        return np.concatenate(parts)

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """JᵀJ, (P, P), and Jᵀr, (P,), with `weight` (R,) on each mode."""
        normal = np.zeros((x.size, x.size))
        gradient = np.zeros(x.size)
        start = 0
        for e, tau in zip(self.evidence, self.tau, strict=True):
            w = weight[start : start + e.omega.size]
            start += e.omega.size
            basis = modal_basis(e.family.at(x[None]))
            d_mass, d_stiffness = e.family.derivatives(x)
            jacobian, residual = (_ridge_jacobian if e.has_shapes else _nearest_jacobian)(
                e, tau, basis, d_mass, d_stiffness
            )
            scaled = (jacobian * w[None, :, None]).reshape(x.size, -1)
            flat = jacobian.reshape(x.size, -1)
            normal += (scaled @ flat.conj().T).real
            gradient += (scaled.conj() @ residual.ravel()).real
        return normal, gradient


def _ridge(
    e: Dataset, tau: NDArray[np.float64], basis: Basis
) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Modal coordinates (R, n), costs (R,), weighted sensor matrix (R, n_dofs, n), penalties (R, n)."""
    at_sensors = e.rows @ basis.shapes[0]
    b = e.shape_weight[:, :, None] * at_sensors
    rhs = e.shapes * e.shape_weight
    distance = (basis.eigenvalues[0][None, :] - e.omega[:, None] ** 2) / (tau * e.omega**2)[:, None]
    power = np.sum(np.abs(e.shapes) ** 2, axis=1) / np.mean(np.sum(at_sensors**2, axis=0))
    # The size a_r of the latent shape belongs to the solution: a second pass takes it from the first.
    for _ in range(2):
        d = distance / np.sqrt(np.maximum(power, 1e-300))[:, None]
        normal = b.swapaxes(-1, -2) @ b
        diagonal = np.einsum("rii->ri", normal)
        diagonal += d**2 + 1e-9 * diagonal.mean(axis=1, keepdims=True) + 1e-30
        right = np.einsum("rsn,rs->rn", b, rhs)
        both = np.linalg.solve(normal, np.stack([right.real, right.imag], axis=-1))
        q = both[..., 0] + 1j * both[..., 1]
        power = np.sum(np.abs(q) ** 2, axis=1)
    misfit = np.einsum("rsn,rn->rs", b, q) - rhs
    cost = np.sum(np.abs(misfit) ** 2, axis=1) + np.sum(np.abs(d * q) ** 2, axis=1)
    return q, cost, b, d


def _ridge_jacobian(
    e: Dataset,
    tau: NDArray[np.float64],
    basis: Basis,
    d_mass: NDArray[np.float64],
    d_stiffness: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Jacobian (P, R, n_dofs + n) and residual (R, n_dofs + n), in the modal coordinates of the point."""
    q, _, b, d = _ridge(e, tau, basis)
    phi = basis.shapes[0]
    n_dofs, n = b.shape[1:]
    by_stiffness = np.einsum("ia,pij,jb->pab", phi, d_stiffness, phi, optimize=True)
    by_mass = np.einsum("ia,pij,jb->pab", phi, d_mass, phi, optimize=True)
    scale = 1 / (tau * e.omega**2 * np.maximum(np.linalg.norm(q, axis=1), 1e-150))
    moved = (
        by_stiffness @ (q * scale[:, None]).T - by_mass @ (q * (scale * e.omega**2)[:, None]).T
    ).swapaxes(1, 2)
    full = np.concatenate([np.zeros((len(moved), len(q), n_dofs)), moved], axis=2)
    diagonal = np.zeros((len(q), n, n))
    diagonal[:, np.arange(n), np.arange(n)] = d
    a = np.concatenate([b, diagonal], axis=1)
    span, _ = np.linalg.qr(a)
    inside = np.einsum("rmn,prm->prn", span, full)
    jacobian = full - np.einsum("rmn,prn->prm", span, inside)
    residual = np.concatenate([np.einsum("rsn,rn->rs", b, q) - e.shapes * e.shape_weight, d * q], axis=1)
    return jacobian, residual


def _nearest(
    e: Dataset, tau: NDArray[np.float64], basis: Basis
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For frequencies without shapes: the assigned model mode and the residual of each, (R,)."""
    values = basis.eigenvalues[0]
    distance = (values[None, :] - e.omega[:, None] ** 2) / (tau * e.omega**2)[:, None]
    # Far beyond any tolerance all model modes are equally wrong; the cap keeps the assignment robust.
    rows, columns = linear_sum_assignment(np.minimum(distance**2, 1e8))
    chosen = np.full(e.omega.size, int(np.argmax(values)), dtype=np.int64)
    chosen[rows] = columns
    return chosen, distance[np.arange(e.omega.size), chosen]


def _nearest_jacobian(
    e: Dataset,
    tau: NDArray[np.float64],
    basis: Basis,
    d_mass: NDArray[np.float64],
    d_stiffness: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    chosen, residual = _nearest(e, tau, basis)
    phi = basis.shapes[0][:, chosen]
    by_stiffness = np.einsum("ir,pij,jr->pr", phi, d_stiffness, phi, optimize=True)
    by_mass = np.einsum("ir,pij,jr->pr", phi, d_mass, phi, optimize=True)
    slope = (by_stiffness - basis.eigenvalues[0][chosen] * by_mass) / (tau * e.omega**2)
    return slope[:, :, None].astype(complex), residual[:, None].astype(complex)
