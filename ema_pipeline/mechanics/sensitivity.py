"""Derivatives of eigenvalues and shapes with respect to changes of mass and stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.mechanics.system import LinearSystem

EQUAL = 1e-9
"""Eigenvalues closer than this share of the largest one count as one repeated eigenvalue."""


@dataclass(frozen=True)
class EigenSensitivity:
    """Modes and their derivatives along p directions of change.

    Attributes
    ----------
    eigenvalues : ndarray, (n,)
        ω², (rad/s)².
    groups : tuple of (int, int)
        Ranges start:stop of modes with equal eigenvalues; a range of one for a mode on its own.
    eigenvalue_derivatives : ndarray, (p, n)
        For a repeated eigenvalue the derivatives of its branches, in ascending order.
    shapes : ndarray, (p, n, n)
        ``[k, :, r]`` is shape r, mass-normalised. Of the shapes of a repeated eigenvalue those are given that
        lead into its branches along direction k, so they differ from direction to direction.
    shape_derivatives : ndarray, (p, n, n)
        ``[k, :, r]`` is the derivative of ``shapes[k, :, r]`` along direction k. Branches that do not part to
        first order have no shapes of their own: among these only the change of scale is given.
    """

    eigenvalues: NDArray[np.float64]
    groups: tuple[tuple[int, int], ...]
    eigenvalue_derivatives: NDArray[np.float64]
    shapes: NDArray[np.float64]
    shape_derivatives: NDArray[np.float64]

    @property
    def frequency_derivatives(self) -> NDArray[np.float64]:
        """Derivatives of the natural frequencies in Hz, (p, n); 0 for modes at 0 Hz, where none exists."""
        omega = np.sqrt(self.eigenvalues)
        elastic = omega > 0
        result = np.zeros_like(self.eigenvalue_derivatives)
        result[:, elastic] = self.eigenvalue_derivatives[:, elastic] / (4 * np.pi * omega[elastic])
        return result


def eigen_sensitivity(
    system: LinearSystem, mass_changes: NDArray[np.float64], stiffness_changes: NDArray[np.float64]
) -> EigenSensitivity:
    """Analytic derivatives of all modes, also of repeated ones.

    Parameters
    ----------
    system : LinearSystem
    mass_changes, stiffness_changes : ndarray, (p, n, n)
        dM/dp and dK/dp for each of p parameters, on which M and K depend linearly (as they do on masses
        and stiffnesses). Second derivatives would enter the shapes of repeated eigenvalues only.

    Notes
    -----
    dλ_r = φ_rᵀ(K' - λM')φ_r; for a repeated eigenvalue the eigenvalues of that form on its subspace, whose
    eigenvectors turn the shapes into those of the branches. Shapes by modal expansion, complete here because
    all modes are at hand; within a repeated eigenvalue from the second derivative of the eigenproblem.

    References
    ----------
    R. L. Fox, M. P. Kapoor, "Rates of change of eigenvalues and eigenvectors", *AIAA J.* 6 (1968) 2426-2429.
    R. L. Dailey, "Eigenvector derivatives with repeated eigenvalues", *AIAA J.* 27 (1989) 486-491.
    """
    values, basis = eigen_solution(system)
    groups = equal_groups(values)
    slopes, shapes, derivatives = [], [], []
    for dm, dk in zip(np.asarray(mass_changes, float), np.asarray(stiffness_changes, float), strict=True):
        phi = basis @ _into_branches(basis.T @ dm @ basis, basis.T @ dk @ basis, values, groups)
        m, k = phi.T @ dm @ phi, phi.T @ dk @ phi
        slope = np.diag(k) - values * np.diag(m)
        slopes.append(slope)
        shapes.append(phi)
        derivatives.append(phi @ _expansion(m, k, values, slope, groups))
    size = (len(slopes), len(values))
    return EigenSensitivity(
        eigenvalues=values,
        groups=groups,
        eigenvalue_derivatives=np.reshape(slopes, size),
        shapes=np.reshape(shapes, (*size, size[1])),
        shape_derivatives=np.reshape(derivatives, (*size, size[1])),
    )


def _into_branches(
    m: NDArray[np.float64],
    k: NDArray[np.float64],
    values: NDArray[np.float64],
    groups: tuple[tuple[int, int], ...],
) -> NDArray[np.float64]:
    """Rotation of the modes within each group that makes K' - λM' diagonal there, (n, n)."""
    turn = np.eye(len(values))
    for start, stop in groups:
        if stop - start > 1:
            g = slice(start, stop)
            form = k[g, g] - np.mean(values[g]) * m[g, g]
            turn[g, g] = np.linalg.eigh(0.5 * (form + form.T))[1]
    return turn


def _expansion(
    m: NDArray[np.float64],
    k: NDArray[np.float64],
    values: NDArray[np.float64],
    slope: NDArray[np.float64],
    groups: tuple[tuple[int, int], ...],
) -> NDArray[np.float64]:
    """Coefficients of the shapes' derivatives over the shapes, (n, n): column r belongs to mode r."""
    forms = k - values[None, :] * m  # [s, r] = φ_sᵀ(K' - λ_r M')φ_r
    weights = np.zeros_like(m)
    for start, stop in groups:
        g = slice(start, stop)
        others = np.r_[0:start, stop : len(values)]
        out = forms[others, g] / (values[None, g] - values[others, None])
        weights[others, g] = out
        inside = -0.5 * m[g, g]
        parting = slope[None, g] - slope[g, None]  # [i, j] = λ'_j - λ'_i
        apart = np.abs(parting) > EQUAL * max(float(np.max(np.abs(slope))), 1e-300)
        second = forms[others, g].T @ out - m[g, g] * slope[None, g]
        inside[apart] = second[apart] / parting[apart]
        weights[g, g] = inside
    return weights


def equal_groups(values: NDArray[np.float64]) -> tuple[tuple[int, int], ...]:
    """Ranges of ascending eigenvalues that are equal to `EQUAL`."""
    limit = EQUAL * max(float(np.max(np.abs(values), initial=0.0)), 1e-300)
    starts = [0, *(np.flatnonzero(np.diff(values) > limit) + 1).tolist(), len(values)]
    return tuple((a, b) for a, b in pairwise(starts) if b > a)
