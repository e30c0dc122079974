"""Residuals of paired modes: frequencies, damping ratios and shapes of the model's own modes.

Unlike the latent-shape objective this one leaves no freedom to coordinates that carry no sensor: the model's
mode
must have the measured frequency, damping and shape. Shapes of modes that nearly coincide are compared by the
space that they span, with a smooth transition: mode j may mix into mode k with an amplitude of the order
mixing·λ_k/|λ_j - λ_k|, which is what an unmodelled relative perturbation `mixing` of the matrices does
(first-order
perturbation theory). Equal eigenvalues mix freely, distant ones not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.evidence import Evidence
from ema_pipeline.mechanics.system import LinearSystem

_FAINT = 0.1


@dataclass(frozen=True)
class Matrices:
    """Matrices of a batch of systems: mass, stiffness, damping, structural (B, n, n); damping ratio (B,)."""

    mass: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    structural: NDArray[np.float64]
    modal_damping_ratio: NDArray[np.float64]
    damped: bool


def matrices(system: LinearSystem) -> Matrices:
    """A batch of one."""
    return Matrices(
        system.mass[None],
        system.stiffness[None],
        system.damping[None],
        system.structural[None],
        np.array([system.modal_damping_ratio]),
        bool(np.any(system.damping) or np.any(system.structural)),
    )


@dataclass(frozen=True)
class Basis:
    """Undamped modes of a batch of systems.

    Attributes
    ----------
    eigenvalues : ndarray, (B, n)
        ω², ascending.
    shapes : ndarray, (B, n, n)
        Mass-normalised, one mode per column.
    directions : ndarray, (B, n, n)
        The same in mass-scaled coordinates (Lᵀ·shape with M = L·Lᵀ): orthonormal columns.
    """

    eigenvalues: NDArray[np.float64]
    shapes: NDArray[np.float64]
    directions: NDArray[np.float64]


def modal_basis(m: Matrices) -> Basis:
    """Undamped modes of a batch of systems."""
    lower = np.linalg.cholesky(m.mass)
    half = np.linalg.solve(lower, m.stiffness)
    scaled = np.linalg.solve(lower, half.swapaxes(-1, -2))
    values, directions = np.linalg.eigh(0.5 * (scaled + scaled.swapaxes(-1, -2)))
    shapes = np.linalg.solve(lower.swapaxes(-1, -2), directions)
    return Basis(values, shapes, directions)


@dataclass(frozen=True)
class Modes:
    """Modes of a batch of systems as a test would find them, in order of frequency.

    Attributes
    ----------
    omega, damping_ratio : ndarray, (B, n)
    shapes, directions : ndarray, (B, n, n)
        Real for a system without dampers; complex otherwise.
    """

    omega: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    shapes: NDArray[np.float64] | NDArray[np.complex128]
    directions: NDArray[np.float64] | NDArray[np.complex128]


def observable_modes(m: Matrices) -> Modes:
    """Modes with the damping that the system has: |s|, ζ and shapes, complex where dampers make them so."""
    basis = modal_basis(m)
    omega = np.sqrt(np.maximum(basis.eigenvalues, 0.0))
    n = omega.shape[1]
    if not m.damped:
        ratio = np.broadcast_to(m.modal_damping_ratio[:, None], omega.shape)
        return Modes(omega, ratio, basis.shapes, basis.directions)
    transposed = basis.shapes.swapaxes(-1, -2)
    viscous = transposed @ m.damping @ basis.shapes
    viscous = viscous + np.eye(n) * (2 * m.modal_damping_ratio[:, None] * omega)[:, None, :]
    elastic = transposed @ (m.stiffness + 1j * m.structural) @ basis.shapes
    # State (scale·q, q̇): both halves of one size.
    scale = np.maximum(omega[:, -1], 1.0)[:, None, None]
    state = np.zeros((len(omega), 2 * n, 2 * n), dtype=complex)
    state[:, :n, n:] = scale * np.eye(n)
    state[:, n:, :n] = -elastic / scale
    state[:, n:, n:] = -viscous
    poles, vectors = np.linalg.eig(state)
    upper = np.argsort(-poles.imag, axis=1, kind="stable")[:, :n]
    poles = np.take_along_axis(poles, upper, axis=1)
    order = np.argsort(np.abs(poles), axis=1, kind="stable")
    poles = np.take_along_axis(poles, order, axis=1)
    upper = np.take_along_axis(upper, order, axis=1)
    modal = np.take_along_axis(vectors[:, :n, :], upper[:, None, :], axis=2)
    modal = modal / np.maximum(np.linalg.norm(modal, axis=1, keepdims=True), 1e-300)
    size = np.abs(poles)
    ratio = -poles.real / np.maximum(size, 1e-300)
    return Modes(size, ratio, basis.shapes @ modal, basis.directions @ modal)


def mode_residuals(e: Evidence, pairs: NDArray[np.int64], modes: Modes, mixing: float) -> NDArray[np.float64]:
    """Measurement minus model of paired modes, in units of the standard uncertainty.

    Parameters
    ----------
    e : Evidence
    pairs : ndarray of int, (R,)
        Model mode of each measured mode, -1 where it has none.
    modes : Modes
        Of a batch of B systems.
    mixing : float
        See the module's description.

    Returns
    -------
    ndarray, (B, R, m)
        Columns: frequency, damping ratio, shape (n_dofs real parts, n_dofs imaginary parts), mixing. Zero for
        modes without partner.
    """
    batch = len(modes.omega)
    has = np.flatnonzero(pairs >= 0)
    k = pairs[has]
    frequency = (modes.omega[:, k] / e.omega[has] - 1) / e.relative_std[has]
    damping = (modes.damping_ratio[:, k] - e.damping[has]) * e.damping_weight[has]
    columns = [frequency[..., None], damping[..., None]]
    if e.has_shapes and has.size:
        at_sensors = e.rows @ modes.shapes
        weight = e.shape_weight[has]
        b = weight[None, :, :, None] * at_sensors[:, None]
        rhs = e.shapes[has] * weight
        eigenvalues = modes.omega**2
        own = np.maximum(eigenvalues[:, k], 1e-12)
        d = np.abs(eigenvalues[:, None, :] - own[:, :, None]) / (mixing * own[:, :, None])
        # A mode that the sensors hardly see must not buy its shape from its neighbours at the price of its own
        # small amplitude: it would fit anything.
        every = np.sum(np.abs(at_sensors) ** 2, axis=1)
        least = (_FAINT**2) * np.max(every, axis=1, keepdims=True)
        seen = np.maximum(np.maximum(every[:, k], least), 1e-30)
        size = np.sqrt(np.sum(np.abs(e.shapes[has]) ** 2, axis=1) / seen)
        d = d / np.maximum(size, 1e-150)[:, :, None]
        normal = b.conj().swapaxes(-1, -2) @ b
        diagonal = np.einsum("brii->bri", normal)
        diagonal += d**2 + 1e-9 * diagonal.mean(axis=2, keepdims=True) + 1e-30
        right = np.einsum("brsn,rs->brn", b.conj(), rhs, optimize=True)
        if np.iscomplexobj(normal):
            q = np.linalg.solve(normal, right[..., None])[..., 0]
        else:
            both = np.linalg.solve(normal, np.stack([right.real, right.imag], axis=-1))
            q = both[..., 0] + 1j * both[..., 1]
        misfit = np.einsum("brsn,brn->brs", b, q, optimize=True) - rhs
        mixed = np.einsum("bmn,brn->brm", modes.directions, d * q, optimize=True)
        columns += [misfit.real, misfit.imag, mixed.real, mixed.imag]
    part = np.concatenate(columns, axis=2)
    out = np.zeros((batch, pairs.size, part.shape[2]))
    out[:, has] = part
    return out
