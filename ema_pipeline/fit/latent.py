"""The latent-shape objective: how nearly does the model's equation hold for each measured mode, unpaired.

For measured mode r with frequency ω_r and shape y_r at the sensors S the full shape u is unknown. Its best guess
minimises ‖(S u - y_r)/σ‖² + ‖W Z_r u‖²/(τ² ω_r⁴ a_r), with Z_r = K - ω_r² M, W the inverse Cholesky factor of M
and a_r = uᵀMu; the minimum is the mode's cost. No pairing is needed, and degenerate shapes may rotate. In the
model's own modal coordinates q the second term is Σ ((λ_k - ω_r²)/(τ ω_r²))² |q_k|²/a_r: one small ridge
regression.

References
----------
J. L. Beck, L. S. Katafygiotis, "Updating models and their uncertainties", J. Eng. Mech. 124, 1998 (system modes as
latent variables). G. H. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
problems whose variables separate", SIAM J. Numer. Anal. 10, 1973; L. Kaufman, BIT 15, 1975 (the Jacobian
used).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.correlate.residuals import Basis, modal_basis, ridge
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.matrices import Derivatives
from ema_pipeline.fit.remembered import Remembered


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
        self._solved = Remembered(self._solve)

    def solved(self, x: NDArray[np.float64]) -> list[LatentShapes | Nearest]:
        """What was found for each configuration at a point."""
        return self._solved(x)

    def _solve(self, x: NDArray[np.float64]) -> list[LatentShapes | Nearest]:
        found: list[LatentShapes | Nearest] = []
        for e, tau in zip(self.evidence, self.tau, strict=True):
            basis = modal_basis(e.family.at(x[None]))
            found.append(_latent_shapes(e, tau, basis) if e.has_shapes else _nearest(e, tau, basis))
        return found

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,)."""
        return np.concatenate([s.costs for s in self._solved(x)])

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """JᵀJ, (P, P), and Jᵀr, (P,), with `weight` (R,) on each mode."""
        normal = np.zeros((x.size, x.size))
        gradient = np.zeros(x.size)
        start = 0
        for e, solved in zip(self.evidence, self._solved(x), strict=True):
            w = weight[start : start + e.omega.size]
            start += e.omega.size
            part, slope = solved.terms(e, e.family.derivatives(x), w)
            normal += part
            gradient += slope
        return normal, gradient


@dataclass(frozen=True)
class LatentShapes:
    """The full shapes that come nearest to those measured on one configuration.

    Attributes
    ----------
    basis : Basis
    tau : ndarray, (R,)
    amplitudes : complex ndarray, (R, n)
        Modal coordinates of the shapes.
    penalty : ndarray, (R, n)
    normal : ndarray, (R, n, n)
    costs : ndarray, (R,)
    """

    basis: Basis
    tau: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    penalty: NDArray[np.float64]
    normal: NDArray[np.float64]
    costs: NDArray[np.float64]

    def terms(
        self, e: Dataset, by: Derivatives, weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normal matrix (P, P) and gradient (P,), in the modal coordinates of the point."""
        q, phi = self.amplitudes, self.basis.shapes[0]
        size = self.tau * e.omega**2 * np.maximum(np.linalg.norm(q, axis=1), 1e-150)
        change = q / size[:, None]
        moved = change @ (phi.T @ by.stiffness @ phi)
        moved -= (change * (e.omega**2)[:, None]) @ (phi.T @ by.mass @ phi)
        return projected_terms(moved, self.penalty * q, self.penalty, self.normal, weight)


def _latent_shapes(e: Dataset, tau: NDArray[np.float64], basis: Basis) -> LatentShapes:
    at_sensors = e.rows @ basis.shapes[0]
    b = e.shape_weight[:, :, None] * at_sensors
    target = (e.shapes * e.shape_weight)[..., None]
    distance = (basis.eigenvalues[0][None, :] - e.omega[:, None] ** 2) / (tau * e.omega**2)[:, None]
    power = np.sum(np.abs(e.shapes) ** 2, axis=1) / np.mean(np.sum(at_sensors**2, axis=0))
    # The size a_r of the latent shape belongs to the solution: a second pass takes it from the first.
    for _ in range(2):
        d = distance / np.sqrt(np.maximum(power, 1e-300))[:, None]
        q, normal = ridge(b, target, d)
        power = np.sum(np.abs(q) ** 2, axis=1)
    misfit = b @ q[..., None] - target
    cost = np.sum(np.abs(misfit[..., 0]) ** 2, axis=1) + np.sum(np.abs(d * q) ** 2, axis=1)
    return LatentShapes(basis, tau, q, d, normal.real, cost)


def projected_terms(
    moved: NDArray[np.complex128],
    residual: NDArray[np.complex128],
    penalty: NDArray[np.float64],
    normal: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gauss-Newton terms of ridge regressions whose amplitudes follow the parameters (Kaufman's projection).

    Parameters
    ----------
    moved : complex ndarray, (P, R, n)
        Derivatives of the penalty part of the residual at fixed amplitudes.
    residual : complex ndarray, (R, n)
        The penalty part of the residual, penalty·amplitudes.
    penalty : ndarray, (R, n)
    normal : ndarray, (R, n, n)
        Normal matrices of the regressions.
    weight : ndarray, (R,)

    Returns
    -------
    normal, gradient : ndarray, (P, P), (P,)
    """
    inside = penalty[:, :, None] * np.linalg.inv(normal) * penalty[:, None, :]
    scaled = moved * weight[:, None]
    # What the amplitudes can follow costs nothing: the complement of the span of the regression is left.
    left = scaled - (inside @ scaled.transpose(1, 2, 0)).transpose(2, 0, 1)
    count = len(moved)
    flat = moved.reshape(count, -1).conj()
    return (left.reshape(count, -1) @ flat.T).real, (flat @ (residual * weight[:, None]).ravel()).real


@dataclass(frozen=True)
class Nearest:
    """For frequencies without shapes: the assigned model mode and the residual of each, (R,)."""

    basis: Basis
    tau: NDArray[np.float64]
    chosen: NDArray[np.int64]
    residual: NDArray[np.float64]

    @property
    def costs(self) -> NDArray[np.float64]:
        return self.residual**2

    def terms(
        self, e: Dataset, by: Derivatives, weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normal matrix (P, P) and gradient (P,)."""
        slopes = eigenvalue_slopes(self.basis, by)[:, self.chosen] / (self.tau * e.omega**2)
        return (slopes * weight) @ slopes.T, slopes @ (weight * self.residual)


def _nearest(e: Dataset, tau: NDArray[np.float64], basis: Basis) -> Nearest:
    values = basis.eigenvalues[0]
    distance = (values[None, :] - e.omega[:, None] ** 2) / (tau * e.omega**2)[:, None]
    # Far beyond any tolerance all model modes are equally wrong; the cap keeps the assignment robust.
    rows, columns = linear_sum_assignment(np.minimum(distance**2, 1e8))
    chosen = np.full(e.omega.size, int(np.argmax(values)), dtype=np.int64)
    chosen[rows] = columns
    return Nearest(basis, tau, chosen, distance[np.arange(e.omega.size), chosen])


def eigenvalue_slopes(basis: Basis, by: Derivatives) -> NDArray[np.float64]:
    """Derivatives of the eigenvalues of one system by the coordinates, (P, n)."""
    phi = basis.shapes[0]
    by_stiffness = np.sum(phi * (by.stiffness @ phi), axis=1)
    return np.asarray(by_stiffness - basis.eigenvalues[0] * np.sum(phi * (by.mass @ phi), axis=1))
