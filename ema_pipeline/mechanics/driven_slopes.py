"""Exact derivatives of what is marched under forces by the unknowns of mass, damping and stiffness.

References
----------
J. L. Daleckii, S. G. Krein, AMS Translations 47 (1965) 1-30 (derivative of a function of a matrix): modal damping is
one of M⁻¹K, with a ratio for each mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.driven_system import DrivenSystem
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.terms import DAMPING_MATRIX, MASS, STIFFNESS, Matrices

_CLOSE = 1e-6
"""Relative distance of eigenvalues below which the rotation of their shapes into each other is no longer linear."""


def matrix_derivatives(matrices: Matrices) -> NDArray[np.float64]:
    """Derivatives of M, C with its skew part, and K by logarithms, then by effects and geometry, (k, 3, n, n)."""
    t = matrices.terms
    n = len(t.dofs)
    by_log = np.zeros((t.log.shape[1], 3, n, n))
    for place, kind in enumerate((MASS, DAMPING_MATRIX, STIFFNESS)):
        if kind in t.by_kind:
            on, v = t.by_kind[kind]
            by_log[:, place] = np.einsum("tu,ta,tb->uab", matrices.coefficient[on, None] * t.log[on], v, v)
    by_shape = matrices.by_shape[:, [MASS, DAMPING_MATRIX, STIFFNESS]]
    by_shape[:, 1] += matrices.skew_by_shape
    return np.concatenate([by_log, by_shape])


@dataclass(frozen=True)
class ModalDamping:
    """The part of M⁻¹C that damping ratios of the modes make, V·diag(2ζω)·V⁻¹, and how it changes.

    Attributes
    ----------
    shapes, inverse : ndarray, (n, n)
        V and V⁻¹ = VᵀM.
    rates : ndarray, (n,)
        2ζω of every mode, rad/s.
    quotients : ndarray, (n, n)
        Divided differences of the rates over the eigenvalues.
    """

    shapes: NDArray[np.float64]
    inverse: NDArray[np.float64]
    rates: NDArray[np.float64]
    quotients: NDArray[np.float64]

    @classmethod
    def of(cls, system: LinearSystem, ratios: NDArray[np.float64]) -> ModalDamping:
        """Damping ratios (n,) of the modes of a system."""
        values, shapes = eigen_solution(system)
        values = np.maximum(values, 0.0)
        omega = np.sqrt(values)
        rates = 2 * ratios * omega
        apart = values[:, None] - values
        near = (_CLOSE * np.maximum(values[:, None], values)) ** 2
        quotients = (rates[:, None] - rates) * apart / np.maximum(apart**2 + near, 1e-300)
        moving = omega > 0
        np.fill_diagonal(quotients, np.where(moving, ratios / np.where(moving, omega, 1.0), 0.0))
        return cls(shapes, shapes.T @ system.mass, rates, quotients)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The part of M⁻¹C, (n, n); its derivative where all ratios grow alike."""
        return (self.shapes * self.rates) @ self.inverse

    def by_ratio(self, mode: int) -> NDArray[np.float64]:
        """Derivative by the logarithm of one mode's damping ratio, (n, n)."""
        return self.rates[mode] * np.outer(self.shapes[:, mode], self.inverse[mode])

    def by_system(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative where M⁻¹K changes by `change`, (k, n, n)."""
        inner = self.inverse @ change @ self.shapes
        return np.asarray(self.shapes @ (self.quotients * inner) @ self.inverse)


def driven_derivatives(
    system: LinearSystem,
    here: DrivenSystem,
    tangent: NDArray[np.float64],
    change: NDArray[np.float64],
    tangent_change: NDArray[np.float64],
    modal: ModalDamping | None,
) -> tuple[NDArray[np.float64], ...]:
    """Derivatives of a driven system's stiffness, damping, inputs and push, with the derivatives first.

    Parameters
    ----------
    system : LinearSystem
        With the tangents of the nonlinear elements.
    here : DrivenSystem
        Made of it.
    tangent : ndarray, (m,)
        Tangent stiffness of the nonlinear elements, N/m.
    change : ndarray, (k, 3, n, n)
        Derivatives of mass, damping and stiffness; see `matrix_derivatives`.
    tangent_change : ndarray, (k, m)
        Derivatives of `tangent`.
    modal : ModalDamping, optional
        What `here.damping` holds of damping ratios.
    """
    inverse = np.linalg.inv(system.mass)
    rows = here.rows
    mass, damping, stiffness = change[:, 0], change[:, 1], change[:, 2]
    of_tangents = np.einsum("km,ma,mb->kab", tangent_change, rows, rows)
    by_stiffness = inverse @ (stiffness - of_tangents - mass @ here.stiffness)
    viscous = here.damping if modal is None else here.damping - modal.matrix
    by_damping = inverse @ (damping - mass @ viscous)
    if modal is not None:
        whole = here.stiffness + inverse @ (rows.T @ (tangent[:, None] * rows))
        by_damping = by_damping + modal.by_system(inverse @ (stiffness - mass @ whole))
    return by_stiffness, by_damping, -inverse @ mass @ here.inputs, -inverse @ mass @ here.push
