"""Normal and complex modes of a linear system."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.system import LinearSystem


def normal_modes(system: LinearSystem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Undamped modes, in order of frequency.

    Eigenvalues that are zero to rounding are returned as exactly zero: rigid-body modes are at 0 Hz.

    Returns
    -------
    frequency_hz : ndarray, (n,)
    shapes : ndarray, (n, n)
        One mode per column, mass-normalised: ΦᵀMΦ = I.

    Raises
    ------
    EmaError
        If a coordinate has no mass or the stiffness is negative along some mode.
    """
    eigenvalues, shapes = eigen_solution(system)
    return np.sqrt(eigenvalues) / (2 * np.pi), shapes


def eigen_solution(system: LinearSystem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eigenvalues ω², (n,), (rad/s)², rigid-body ones exactly 0, and mass-normalised shapes, (n, n)."""
    try:
        values, shapes = scipy.linalg.eigh(system.stiffness, system.mass, check_finite=False)
    except (np.linalg.LinAlgError, ValueError):
        raise EmaError(_why_not_solvable(system)) from None
    # Rounding of eigh is a few eps of the largest eigenvalue; nothing below that can be told from 0.
    noise = 64 * len(values) * np.finfo(float).eps * max(float(np.max(np.abs(values))), 1e-300)
    if values[0] < -noise:
        worst = system.dofs[int(np.argmax(np.abs(shapes[:, 0])))]
        raise EmaError(
            f"the model's stiffness is negative around '{worst}': check the signs of the parameters"
        )
    values[np.abs(values) <= noise] = 0.0
    return values, shapes


def _why_not_solvable(system: LinearSystem) -> str:
    for name, matrix in (("mass", system.mass), ("stiffness", system.stiffness)):
        if not np.all(np.isfinite(matrix)):
            dof = system.dofs[int(np.argmin(np.all(np.isfinite(matrix), axis=1)))]
            return f"the model's {name} at '{dof}' is not a finite number: check the parameters"
    dof = system.dofs[int(np.argmin(np.diag(system.mass)))]
    return f"the model's mass matrix is not positive around '{dof}': give this coordinate a mass above 0"


def damping_ratios(
    system: LinearSystem, frequency_hz: NDArray[np.float64], shapes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Damping ratio of every normal mode of `normal_modes`, (n,), from the diagonal of the modal damping matrix.

    ζ_r = φᵀCφ/(2ω_r) + φᵀDφ/(2ω_r²) + modal damping ratio; exact where damping does not couple modes, first
    order otherwise (`complex_modes` is exact). Rigid-body modes have 0.
    """
    omega = 2 * np.pi * frequency_hz
    viscous, structural = _modal(system.damping, shapes), _modal(system.structural, shapes)
    ratio = np.zeros(len(omega))
    elastic = omega > 0
    ratio[elastic] = (
        viscous[elastic] / (2 * omega[elastic])
        + structural[elastic] / (2 * omega[elastic] ** 2)
        + system.modal_damping_ratio
    )
    return ratio


def _modal(matrix: NDArray[np.float64], shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Diagonal of φᵀ·matrix·φ, (n,)."""
    return np.asarray(np.sum(shapes * (matrix @ shapes), axis=0)) if matrix.any() else np.zeros(len(shapes.T))


def total_damping(system: LinearSystem) -> NDArray[np.float64]:
    """Viscous matrix with the modal damping ratio turned into its matrix MΦ·diag(2ζω)·ΦᵀM, (n, n)."""
    if system.modal_damping_ratio == 0.0:
        return system.damping
    return system.damping + modal_damping(system, system.modal_damping_ratio)


def modal_damping(system: LinearSystem, ratio: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Viscous matrix of damping ratios of the modes, one for all or (n,), MΦ·diag(2ζω)·ΦᵀM, (n, n)."""
    values, shapes = eigen_solution(system)
    m_phi = system.mass @ shapes
    return np.asarray((m_phi * (2 * ratio * np.sqrt(np.maximum(values, 0.0)))) @ m_phi.T)


@dataclass(frozen=True)
class ComplexModes:
    """Modes of the damped system, in order of |s|.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
        rad/s, Im s > 0; exactly 0 for rigid-body modes. Overdamped modes are left out.
    shapes : complex ndarray, (n, n_modes)
        Scaled so that the receptance is Σ φφᵀ/(2jω_d)/(jω - s) + conj., ω_d = Im s. With gyroscopic
        coupling, where left and right shapes differ, scaled to φᴴMφ = 1. Rigid-body shapes are real and
        mass-normalised.
    """

    poles: NDArray[np.complex128]
    shapes: NDArray[np.complex128]

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Undamped natural frequency |s|/2π, (n_modes,)."""
        return np.asarray(np.abs(self.poles) / (2 * np.pi))

    @property
    def damping_ratio(self) -> NDArray[np.float64]:
        """-Re s/|s|, (n_modes,); 0 for rigid-body modes."""
        size = np.abs(self.poles)
        return np.asarray(0.0 - self.poles.real / np.where(size > 0, size, 1.0))


def complex_modes(system: LinearSystem) -> ComplexModes:
    """Modes with viscous, gyroscopic, structural and modal damping.

    The quadratic eigenproblem (s²M + sC + K + jD)φ = 0 is solved in state space, in the coordinates of the
    undamped modes, where it is well scaled. Structural damping jD holds for positive frequencies, i.e. for
    the poles with Im s > 0 that are returned.

    References
    ----------
    D. J. Ewins, *Modal Testing: Theory, Practice and Application*, 2nd ed., 2000, sections 2.6-2.8.
    """
    values, phi = eigen_solution(system)
    omega = np.sqrt(values)
    n = len(values)
    viscous = phi.T @ system.damping @ phi + np.diag(2 * system.modal_damping_ratio * omega)
    structural = phi.T @ system.structural @ phi
    scale = max(float(omega[-1]), 1.0)
    lossless = np.all(np.abs(structural) <= 1e-12 * scale**2, axis=0)
    rigid = (values == 0) & lossless

    a = np.zeros((2 * n, 2 * n), dtype=complex if np.any(structural) else float)
    # State (scale·q, q̇): both halves of one size, so that the eigenvalues are of order `scale`.
    a[:n, n:] = scale * np.eye(n)
    a[n:, :n] = -(np.diag(values) + (1j * structural if np.iscomplexobj(a) else 0.0)) / scale
    a[n:, n:] = -viscous
    poles, vectors = np.linalg.eig(a)
    keep = poles.imag > 1e-7 * scale
    poles, modal = poles[keep], vectors[:n, keep]
    shapes = phi @ modal
    skew = np.max(np.abs(viscous - viscous.T), initial=0.0) > 1e-12 * max(
        float(np.max(np.abs(viscous), initial=0.0)), 1e-300
    )
    if skew:
        size = np.sqrt(np.sum(np.abs(modal) ** 2, axis=0))
        shapes = shapes / size
    else:
        form = 2 * poles * np.sum(modal**2, axis=0) + np.einsum("ir,ij,jr->r", modal, viscous, modal)
        shapes = shapes * np.sqrt(2j * poles.imag / form)
    poles = np.concatenate([np.zeros(int(rigid.sum()), dtype=complex), poles])
    shapes = np.concatenate([phi[:, rigid].astype(complex), shapes], axis=1)
    order = np.argsort(np.abs(poles), kind="stable")
    return ComplexModes(poles=poles[order], shapes=shapes[:, order])
