"""Residuals of paired modes: frequencies, damping ratios and shapes of the model's own modes.

Unlike the latent-shape objective this one leaves no freedom to coordinates that carry no sensor: the model's mode
must have the measured frequency, damping and shape. Shapes of modes that nearly coincide are compared by the
space that they span, with a smooth transition: mode j may mix into mode k with an amplitude of the order
mixing·λ_k/|λ_j - λ_k|, which is what an unmodelled relative perturbation `mixing` of the matrices does
(first-order perturbation theory). Equal eigenvalues mix freely, distant ones not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.evidence import Evidence
from ema_pipeline.mechanics.system import LinearSystem

_FAINT = 0.1
_FAR = 5.0
"""Logarithm of a size that is wrong beyond all comparison."""


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
    inverse = np.linalg.inv(np.linalg.cholesky(m.mass))
    scaled = inverse @ m.stiffness @ inverse.swapaxes(-1, -2)
    values, directions = np.linalg.eigh(0.5 * (scaled + scaled.swapaxes(-1, -2)))
    return Basis(values, inverse.swapaxes(-1, -2) @ directions, directions)


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


@dataclass(frozen=True)
class ShapeFit:
    """The mixture of model modes that comes nearest to each paired measured shape, R modes of B systems.

    Attributes
    ----------
    amplitudes : complex ndarray, (B, R, n)
        Of the model's modes.
    price : ndarray, (B, R)
        1/(mixing·λ_k·size): what a unit amplitude of a mode costs per distance of its eigenvalue from λ_k; the
        size is that of the measured over the model's shape.
    penalty : ndarray, (B, R, n)
        (λ_j - λ_k)·price.
    weighted : ndarray, (B, R, n_dofs, n)
        The model's modes at the sensors over the standard deviations of the measured shape.
    normal : ndarray, (B, R, n, n)
        Of the least squares: weightedᴴ·weighted + penalty².
    """

    amplitudes: NDArray[np.complex128]
    price: NDArray[np.float64]
    penalty: NDArray[np.float64]
    weighted: NDArray[np.float64] | NDArray[np.complex128]
    normal: NDArray[np.float64] | NDArray[np.complex128]


def visibility(at_sensors: NDArray[np.float64] | NDArray[np.complex128]) -> NDArray[np.float64]:
    """Square of each mode's motion at the sensors, (B, n), at least a share of the largest.

    A mode that the sensors hardly see must not buy its shape from its neighbours at the price of its own small
    motion: it would fit anything.
    """
    seen = np.sum(np.abs(at_sensors) ** 2, axis=-2)
    return np.asarray(np.maximum(np.maximum(seen, _FAINT**2 * seen.max(axis=-1, keepdims=True)), 1e-30))


def shape_fit(e: Evidence, pairs: NDArray[np.int64], modes: Modes, mixing: float) -> ShapeFit | None:
    """Fit of the shapes of the measured modes that have a partner, see `mode_residuals`; None without shapes."""
    has = np.flatnonzero(pairs >= 0)
    if not e.has_shapes or not has.size:
        return None
    k = pairs[has]
    at_sensors = e.rows @ modes.shapes
    weight = e.shape_weight[has]
    weighted = weight[None, :, :, None] * at_sensors[:, None]
    target = (e.shapes[has] * weight)[None, :, :, None]
    eigenvalues = modes.omega**2
    own = np.maximum(eigenvalues[:, k], 1e-12)
    size = np.sqrt(np.sum(np.abs(e.shapes[has]) ** 2, axis=1) / visibility(at_sensors)[:, k])
    price = 1 / (mixing * own * np.maximum(size, 1e-150))
    penalty = (eigenvalues[:, None, :] - own[:, :, None]) * price[:, :, None]
    amplitudes, normal = ridge(weighted, target, penalty)
    return ShapeFit(amplitudes, price, penalty, weighted, normal)


def ridge(
    weighted: NDArray[np.float64] | NDArray[np.complex128],
    target: NDArray[np.complex128],
    penalty: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.float64] | NDArray[np.complex128]]:
    """Amplitudes q, (..., n), of least ‖weighted·q - target‖² + ‖penalty·q‖², and the normal matrix."""
    transposed = weighted.conj().swapaxes(-1, -2)
    normal = transposed @ weighted
    diagonal = np.einsum("...ii->...i", normal)
    diagonal += penalty**2 + 1e-9 * diagonal.real.mean(axis=-1, keepdims=True) + 1e-30
    if np.iscomplexobj(normal):
        return np.asarray(np.linalg.solve(normal, transposed @ target)[..., 0], dtype=complex), normal
    parts = transposed @ np.concatenate([target.real, target.imag], axis=-1)
    both = np.linalg.solve(normal, parts)
    return both[..., 0] + 1j * both[..., 1], normal


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
        Columns: frequency, damping ratio, shape (n_dofs real parts, n_dofs imaginary parts), mixing, size of a
        mass-normalised shape. Zero for modes without partner.
    """
    return residuals_of(e, pairs, modes, shape_fit(e, pairs, modes, mixing))


def residuals_of(
    e: Evidence, pairs: NDArray[np.int64], modes: Modes, fit: ShapeFit | None
) -> NDArray[np.float64]:
    """`mode_residuals` where the shapes are fitted already."""
    has = np.flatnonzero(pairs >= 0)
    k = pairs[has]
    frequency = (modes.omega[:, k] / e.omega[has] - 1) / e.relative_std[has]
    damping = (modes.damping_ratio[:, k] - e.damping[has]) * e.damping_weight[has]
    columns = [frequency[..., None], damping[..., None]]
    if fit is not None:
        misfit = (fit.weighted @ fit.amplitudes[..., None])[..., 0] - e.shapes[has] * e.shape_weight[has]
        mixed = (fit.penalty * fit.amplitudes) @ modes.directions.swapaxes(-1, -2)
        columns += [misfit.real, misfit.imag, mixed.real, mixed.imag]
        columns += [size_residuals(e, has, fit)[..., None]]
    part = np.concatenate(columns, axis=2)
    out = np.zeros((len(modes.omega), pairs.size, part.shape[2]))
    out[:, has] = part
    return out


def size_residuals(e: Evidence, has: NDArray[np.int64], fit: ShapeFit) -> NDArray[np.float64]:
    """Logarithm of measured over modelled size of mass-normalised shapes over its standard uncertainty, (B, R).

    Modes of the model have unit modal mass, and so has a mixture of them with amplitudes of unit length.
    """
    length = np.linalg.norm(fit.amplitudes, axis=-1)
    logarithm = np.log(np.maximum(length, 1e-300)) + e.log_size[has]
    return np.asarray(np.clip(logarithm, -_FAR, _FAR) * e.size_weight[has])
