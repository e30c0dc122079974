"""Residuals of paired modes: frequencies, damping ratios and shapes of the model's own modes.

Unlike the latent-shape objective this one leaves no freedom to coordinates that carry no sensor: the model's mode
must have the measured frequency, damping and shape. Shapes of modes that nearly coincide are compared by the
space that they span, with a smooth transition: mode j may mix into mode k with an amplitude of the order
mixing·λ_k/|λ_j - λ_k|, which is what an unmodelled relative perturbation `mixing` of the matrices does (first-order
perturbation theory). Equal eigenvalues mix freely, distant ones not at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.fit.evidence import Evidence, Modes, observable_modes

_STEP = 1e-4


class ExactObjective:
    """Cost of every measured mode of all configurations with fixed pairs.

    Parameters
    ----------
    evidence : sequence of Evidence
    pairs : sequence of ndarray, (R,)
        Per configuration the model mode of each measured mode, -1 where it has none.
    mixing : float
        See the module's description.
    """

    def __init__(self, evidence: Sequence[Evidence], pairs: Sequence[NDArray[np.int64]], mixing: float) -> None:
        self.evidence = evidence
        self.pairs = pairs
        self.mixing = mixing
        self.paired = np.concatenate([p >= 0 for p in pairs])

    def residuals(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Residuals in units of the standard uncertainty, per configuration (B, R, m), at points (B, P).

        Columns: frequency, damping ratio, shape (real and imaginary parts), mixing; 0 for modes without partner.
        """
        return [
            _residuals(e, p, observable_modes(e.family.at(x)), self.mixing)
            for e, p in zip(self.evidence, self.pairs, strict=True)
        ]

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,); infinite where the mode has no partner."""
        squares = np.concatenate([np.sum(r[0] ** 2, axis=1) for r in self.residuals(x[None])])
        return np.where(self.paired, squares, np.inf)

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """JᵀJ, (P, P), and Jᵀr, (P,), with `weight` (R,) on each mode; Jacobian by central differences."""
        count = x.size
        points = np.vstack([x[None], x + _STEP * np.eye(count), x - _STEP * np.eye(count)])
        normal, gradient = np.zeros((count, count)), np.zeros(count)
        start = 0
        for r in self.residuals(points):
            w = np.sqrt(weight[start : start + r.shape[1]])[None, :, None]
            start += r.shape[1]
            weighted = (r * w).reshape(len(points), -1)
            jacobian = (weighted[1 : count + 1] - weighted[count + 1 :]) / (2 * _STEP)
            normal += jacobian @ jacobian.T
            gradient += jacobian @ weighted[0]
        return normal, gradient


def _residuals(
    e: Evidence, pairs: NDArray[np.int64], modes: Modes, mixing: float
) -> NDArray[np.float64]:
    batch, n = modes.omega.shape
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
        seen = np.maximum(np.sum(np.abs(at_sensors[:, :, k]) ** 2, axis=1), 1e-30)
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
