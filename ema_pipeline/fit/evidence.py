"""The measured modes of one configuration, prepared for residuals, and batched modal bases of the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes, with_floors
from ema_pipeline.correlate.pairing import sensor_rows
from ema_pipeline.fit.matrices import Matrices, MatrixFamily
from ema_pipeline.fit.settings import FitSettings


@dataclass(frozen=True)
class Evidence:
    """One configuration's modes with standard uncertainties, shapes scaled to a largest entry of 1.

    Attributes
    ----------
    measured : MeasuredModes
        With floors.
    family : MatrixFamily
    rows : ndarray, (n_dofs, n)
    omega : ndarray, (R,)
        rad/s.
    relative_std : ndarray, (R,)
        Of the frequency.
    damping, damping_weight : ndarray, (R,)
        Damping ratio and 1/std; 0 where not used.
    shapes : complex ndarray, (R, n_dofs)
        0 where not measured.
    shape_weight : ndarray, (R, n_dofs)
        1/std; 0 where not measured.
    counts : ndarray, (R,)
        Number of real data of each mode, one scale factor per shape taken off.
    """

    measured: MeasuredModes
    family: MatrixFamily
    rows: NDArray[np.float64]
    omega: NDArray[np.float64]
    relative_std: NDArray[np.float64]
    damping: NDArray[np.float64]
    damping_weight: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    shape_weight: NDArray[np.float64]
    counts: NDArray[np.float64]

    @property
    def has_shapes(self) -> bool:
        return bool(np.any(self.shape_weight > 0))

    def outlier_cost(self, scale: float) -> NDArray[np.float64]:
        """-2 log likelihood of a mode of any shape anywhere in the band, relative to a perfect fit, (R,).

        `scale` multiplies all standard uncertainties.
        """
        band = self.measured.band_hz
        f = self.measured.frequency_hz
        width = max(band[1] - band[0], 1e-9) if band is not None else max(float(f.max()), 1e-9)
        anywhere = width / (scale * self.relative_std * f * np.sqrt(2 * np.pi))
        power = np.sum(np.abs(self.shapes) ** 2, axis=1)
        size = np.sqrt(power / np.maximum(np.sum(self.shape_weight > 0, axis=1), 1))
        any_shape = np.where(self.shape_weight > 0, size[:, None] * self.shape_weight / scale, 1.0)
        bits = np.sum(np.log(np.maximum(any_shape, 1.0)), axis=1) + np.log(np.maximum(anywhere, 1.0))
        return np.asarray(self.counts + 2 * bits)


def gather(measured: MeasuredModes, family: MatrixFamily, settings: FitSettings) -> Evidence:
    """Prepare one configuration's measured modes."""
    m = with_floors(measured, settings)
    rows = sensor_rows(family.system, m)
    damping = np.nan_to_num(m.damping_ratio)
    known = np.isfinite(m.damping_ratio) & (m.damping_ratio > 0) & settings.damping
    damping_weight = np.where(known, 1 / np.where(known, m.damping_std, 1.0), 0.0)
    if m.shapes is None or m.shape_std is None or not m.dofs:
        shapes = np.zeros((len(m), 0), dtype=complex)
        weight = np.zeros((len(m), 0))
        shape_counts = np.zeros(len(m))
    else:
        valid = np.isfinite(m.shapes)
        shapes = np.where(valid, m.shapes, 0.0)
        size = np.maximum(np.max(np.abs(shapes), axis=1, keepdims=True), 1e-300)
        shapes = shapes / size
        weight = np.where(valid, size / np.where(valid, m.shape_std, 1.0), 0.0)
        # One complex scale factor is free; a table of real shapes carries no information on phase.
        parts = 1.0 if not np.any(shapes.imag) else 2.0
        shape_counts = parts * np.maximum(valid.sum(axis=1) - 1, 0)
    return Evidence(
        measured=m,
        family=family,
        rows=rows,
        omega=2 * np.pi * m.frequency_hz,
        relative_std=m.frequency_std_hz / m.frequency_hz,
        damping=damping,
        damping_weight=damping_weight,
        shapes=np.asarray(shapes, dtype=complex),
        shape_weight=weight,
        counts=1.0 + known + shape_counts,
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
