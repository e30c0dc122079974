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
    shapes : ndarray, (n, n)
        Mass-normalised, one mode per column.
    groups : tuple of (int, int)
        Ranges start:stop of modes with equal eigenvalues; a range of one for a mode on its own.
    eigenvalue_derivatives : ndarray, (p, n)
        For a repeated eigenvalue the derivatives of its branches, in ascending order.
    shape_derivatives : ndarray, (p, n, n)
        ``[k, :, r]`` is the derivative of shape r along direction k. Inside a group of equal eigenvalues only
        the change that leads out of the group's subspace, and that of the scale, is defined and given.
    """

    eigenvalues: NDArray[np.float64]
    shapes: NDArray[np.float64]
    groups: tuple[tuple[int, int], ...]
    eigenvalue_derivatives: NDArray[np.float64]
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
    """Analytic derivatives of all modes.

    Parameters
    ----------
    system : LinearSystem
    mass_changes, stiffness_changes : ndarray, (p, n, n)
        dM/dp and dK/dp for each of p parameters.

    Notes
    -----
    dλ_r = φ_rᵀ(K' - λM')φ_r; for a repeated eigenvalue the eigenvalues of that form on its subspace. Shapes
    by modal expansion, complete here because all modes are at hand.

    References
    ----------
    R. L. Fox, M. P. Kapoor, "Rates of change of eigenvalues and eigenvectors", *AIAA J.* 6 (1968) 2426-2429.
    R. B. Nelson, *AIAA J.* 14 (1976) 1201-1205; for repeated eigenvalues I. U. Ojalvo, *AIAA J.* 26 (1988)
    361-366.
    """
    values, phi = eigen_solution(system)
    dm = np.einsum("ir,kij,js->krs", phi, np.asarray(mass_changes, dtype=float), phi, optimize=True)
    dk = np.einsum("ir,kij,js->krs", phi, np.asarray(stiffness_changes, dtype=float), phi, optimize=True)
    groups = equal_groups(values)
    forms = dk - values[None, None, :] * dm  # [k, s, r] = φ_sᵀ(K' - λ_r M')φ_r
    d_values = np.empty((len(dm), len(values)))
    label = np.empty(len(values), dtype=int)
    for i, (start, stop) in enumerate(groups):
        label[start:stop] = i
        block = forms[:, start:stop, start:stop]
        d_values[:, start:stop] = np.linalg.eigvalsh(0.5 * (block + block.transpose(0, 2, 1)))
    together = label[:, None] == label[None, :]
    gap = np.where(together, 1.0, values[None, :] - values[:, None])  # [s, r] = λ_r - λ_s
    weights = np.where(together[None], -0.5 * dm, forms / gap[None])
    return EigenSensitivity(
        eigenvalues=values,
        shapes=phi,
        groups=groups,
        eigenvalue_derivatives=d_values,
        shape_derivatives=np.einsum("is,ksr->kir", phi, weights, optimize=True),
    )


def equal_groups(values: NDArray[np.float64]) -> tuple[tuple[int, int], ...]:
    """Ranges of ascending eigenvalues that are equal to `EQUAL`."""
    limit = EQUAL * max(float(np.max(np.abs(values), initial=0.0)), 1e-300)
    starts = [0, *(np.flatnonzero(np.diff(values) > limit) + 1).tolist(), len(values)]
    return tuple((a, b) for a, b in pairwise(starts) if b > a)
