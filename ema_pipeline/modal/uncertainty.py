"""Covariance of poles, participations and shapes, and how significant each mode is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import real_columns, residual_columns
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import (
    Estimate,
    LinearSolution,
    mixing,
    newton_step,
    parameter_columns,
    solve_scaled,
    weighted_grams,
)
from ema_pipeline.modal.noise import Noise

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Covariance:
    """Covariance of the nonlinear parameters and of the shapes.

    Attributes
    ----------
    parameters : ndarray, (n_parameters, n_parameters)
        In the order of `fit.parameter_columns`.
    shapes : ndarray, (n_rows, 2M, 2M)
        Covariance of (Re, Im) of all modes' shape entries of each row, the poles' errors included.
    """

    parameters: Real
    shapes: Real

    def poles(self, mode: int) -> Real:
        """2 × 2 covariance of (Re s, Im s)."""
        return self.parameters[2 * mode : 2 * mode + 2, 2 * mode : 2 * mode + 2]


def covariance(
    data: FitData, weight: Real, estimate: Estimate, solution: LinearSolution, noise: Noise
) -> Covariance:
    """Covariance by linear propagation of the noise through the weighted fit.

    Noise that all outputs of an input have in common does not average out over channels; its share is
    propagated coherently (a sandwich covariance).

    Parameters
    ----------
    data : FitData
    weight : ndarray, (n_rows, n_references, n_lines)
        Weights that the fit used.
    estimate, solution
        Result of the fit with these weights.
    noise : Noise
    """
    m = len(estimate.poles)
    step = newton_step(estimate, solution)
    inverse = _inverse(step.information)
    mix = mixing(estimate.participation)
    z = parameter_columns(estimate, solution.shapes)
    n_par = z.shape[-1]
    columns, derivatives = real_columns(data.omega, estimate.poles, data.rest_s)
    signal = np.concatenate([columns, derivatives])
    residual = residual_columns(data.omega)
    n_rows, n_ref, n_lines = data.frf.shape
    gz = np.matmul(solution.gram, z)
    cross = np.einsum("iba,oibp->oap", mix, gz[:, :, : 2 * m], optimize=True)
    eliminated = solve_scaled(solution.normal, cross)  # minus dψ/dθ
    # parameter sensitivity on lines: columns that act on [mode columns, derivatives], residual terms removed
    meat = np.zeros((n_par, n_par))
    groups = n_rows if data.transposed else n_ref
    per_group = np.zeros((groups, n_par, n_lines), dtype=np.complex128)
    ratio = np.sqrt(noise.common)
    phase = np.where(np.abs(data.frf) > 0, data.frf / np.maximum(np.abs(data.frf), 1e-300), 0.0)
    shape_cov = np.zeros((n_rows, 2 * m, 2 * m))
    for o in range(n_rows):
        row_meat = np.zeros((2 * m, 2 * m))
        linear_inverse = _inverse(solution.normal[o])
        for i in range(n_ref):
            w = weight[o, i]
            if not np.any(w):
                continue
            coefficients = z[o, i].copy()
            coefficients[: 2 * m] -= mix[i] @ eliminated[o]
            corner, _ = weighted_grams(residual, w[None], np.zeros((1, n_lines), complex))
            side = (residual.conj() * w) @ signal.T
            projected = signal - np.linalg.lstsq(corner[0], side.real, rcond=None)[0].T @ residual
            a = coefficients.T @ projected * w  # (n_par, n_lines)
            own = noise.own[o, i]
            meat += 0.5 * ((a * own) @ a.conj().T).real
            group = o if data.transposed else i
            per_group[group] += a.conj() * (ratio[o, i] * phase[o, i])
            x = mix[i].T @ projected[: 2 * m] * w
            row_meat += 0.5 * ((x * noise.variance[o, i]) @ x.conj().T).real
        shape_cov[o] = linear_inverse @ row_meat @ linear_inverse
    for coherent in per_group:
        meat += 0.5 * (coherent @ coherent.conj().T).real
    parameters = inverse @ meat @ inverse
    shape_cov += np.einsum("oap,pq,obq->oab", eliminated, parameters, eliminated, optimize=True)
    return Covariance(0.5 * (parameters + parameters.T), shape_cov)


def _inverse(matrix: Real) -> Real:
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(
        scale[:, None] * np.linalg.pinv(matrix * scale[:, None] * scale[None], rcond=1e-12) * scale[None]
    )


def evidence(solution: LinearSolution, n_modes: int) -> Real:
    """How much the weighted sum of squares would grow without each mode, the other poles kept.

    Returns
    -------
    ndarray, (n_modes,)
        Growth of χ², in units where each real datum adds 1.
    """
    identity = np.broadcast_to(np.eye(2 * n_modes), solution.normal.shape)
    inverse = solve_scaled(solution.normal, identity)
    gain = np.empty(n_modes)
    for r in range(n_modes):
        two = slice(2 * r, 2 * r + 2)
        psi = np.stack([solution.shapes[:, r].real, solution.shapes[:, r].imag], axis=-1)
        gain[r] = 2.0 * np.sum(psi * solve_scaled(inverse[:, two, two], psi[..., None])[..., 0])
    return gain
