"""Gauss-Newton terms of the residuals of paired modes; see `ema_pipeline.correlate.residuals`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.residuals import (
    Basis,
    Modes,
    ShapeFit,
    mode_residuals,
    observable_modes,
    residuals_of,
    shape_fit,
    size_residuals,
    visibility,
)
from ema_pipeline.fit.damped import neighbouring_modes
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.latent import eigenvalue_slopes, projected_terms
from ema_pipeline.fit.matrices import Derivatives
from ema_pipeline.fit.remembered import Remembered

_STEP = 1e-4
_EQUAL = 1e-5

Terms = tuple[NDArray[np.float64], NDArray[np.float64]]


class ExactObjective:
    """Cost of every measured mode of all configurations with fixed pairs.

    Parameters
    ----------
    evidence : sequence of Dataset
    pairs : sequence of ndarray, (R,)
        Per configuration the model mode of each measured mode, -1 where it has none.
    mixing : float
        See `ema_pipeline.correlate.residuals`.
    alone : float
        Cost of a mode without partner.
    """

    def __init__(
        self,
        evidence: Sequence[Dataset],
        pairs: Sequence[NDArray[np.int64]],
        mixing: float,
        alone: float = np.inf,
    ) -> None:
        self.evidence = evidence
        self.pairs = pairs
        self.mixing = mixing
        self.alone = alone
        self.paired = np.concatenate([p >= 0 for p in pairs])
        self._solved = Remembered(self._solve)

    def residuals(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Residuals in units of the standard uncertainty, per configuration (B, R, m), at points (B, P).

        Columns: frequency, damping ratio, shape (real and imaginary parts), mixing; 0 for modes without
        partner.
        """
        return [
            mode_residuals(e, p, observable_modes(e.family.at(x)), self.mixing)
            for e, p in zip(self.evidence, self.pairs, strict=True)
        ]

    def _solve(self, x: NDArray[np.float64]) -> list[tuple[Modes, ShapeFit | None]]:
        found = []
        for e, pairs in zip(self.evidence, self.pairs, strict=True):
            modes = observable_modes(e.family.at(x[None]))
            found.append((modes, shape_fit(e, pairs, modes, self.mixing)))
        return found

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cost of every measured mode at one point, (R,)."""
        squares = [
            np.sum(residuals_of(e, p, modes, fit)[0] ** 2, axis=1)
            for e, p, (modes, fit) in zip(self.evidence, self.pairs, self._solved(x), strict=True)
        ]
        return np.where(self.paired, np.concatenate(squares), self.alone)

    def normal_equations(self, x: NDArray[np.float64], weight: NDArray[np.float64]) -> Terms:
        """JᵀJ, (P, P), and Jᵀr, (P,), with `weight` (R,) on each mode."""
        normal, gradient = np.zeros((x.size, x.size)), np.zeros(x.size)
        start = 0
        for e, pairs, (modes, fit) in zip(self.evidence, self.pairs, self._solved(x), strict=True):
            w = weight[start : start + pairs.size]
            start += pairs.size
            if e.family.damped:
                part, slope = _damped_terms(e, pairs, self.mixing, x, w)
            else:
                part, slope = _undamped_terms(e, pairs, modes, fit, e.family.derivatives(x), w)
            normal += part
            gradient += slope
        return normal, gradient


def _damped_terms(
    e: Dataset, pairs: NDArray[np.int64], mixing: float, x: NDArray[np.float64], weight: NDArray[np.float64]
) -> Terms:
    """By differences to neighbouring systems, whose modes follow from those of the point."""
    modes = neighbouring_modes(e.family.at(x[None]), e.family.derivatives(x), _STEP)
    residuals = mode_residuals(e, pairs, modes, mixing)
    weighted = (residuals * np.sqrt(weight)[None, :, None]).reshape(len(residuals), -1)
    jacobian = (weighted[1:] - weighted[0]) / _STEP
    return jacobian @ jacobian.T, jacobian @ weighted[0]


def _undamped_terms(
    e: Dataset,
    pairs: NDArray[np.int64],
    modes: Modes,
    fit: ShapeFit | None,
    by: Derivatives,
    weight: NDArray[np.float64],
) -> Terms:
    """By the derivatives of eigenvalues, in the modal coordinates of the point.

    The mixing residual is (K - λ_k M)u/(mixing·λ_k·size) in mass-scaled coordinates, u the fitted shape: it needs no
    derivatives of single modes, which for modes that nearly coincide do not exist.
    """
    has = np.flatnonzero(pairs >= 0)
    k, w = pairs[has], weight[has]
    basis = Basis(modes.omega**2, modes.shapes.real, modes.directions.real)
    own = np.maximum(basis.eigenvalues[0, k], 1e-12)
    phi = basis.shapes[0]
    stiffness, mass = phi.T @ by.stiffness @ phi, phi.T @ by.mass @ phi
    slopes = eigenvalue_slopes(basis, by)[:, k]

    frequency = slopes / (2 * np.sqrt(own) * e.omega[has] * e.relative_std[has])
    frequency_residual = (np.sqrt(own) / e.omega[has] - 1) / e.relative_std[has]
    damping = by.modal_damping_ratio[:, None] * e.damping_weight[has]
    damping_residual = (modes.damping_ratio[0, k] - e.damping[has]) * e.damping_weight[has]
    normal = (frequency * w) @ frequency.T + (damping * w) @ damping.T
    gradient = frequency @ (w * frequency_residual) + damping @ (w * damping_residual)
    if fit is None:
        return normal, gradient

    mixed, change = fit.penalty[0] * fit.amplitudes[0], fit.price[0][:, None] * fit.amplitudes[0]
    at_sensors = e.rows @ phi
    seen = np.sum(at_sensors**2, axis=0)
    growth = _amplitude_slopes(at_sensors, basis.eigenvalues[0], k, stiffness, mass)
    size = -growth * e.size_weight[has]
    faint = seen[k] < visibility(at_sensors)[k]
    relative = np.where(faint, 0.0, growth) - slopes / own
    moved = change @ stiffness - (change * own[:, None] + 0.5 * mixed) @ mass
    moved += relative[:, :, None] * mixed - slopes[:, :, None] * change
    part, slope = projected_terms(moved, mixed, fit.penalty[0], fit.normal[0], w)
    part += (size * w) @ size.T
    slope += size @ (w * size_residuals(e, has, fit)[0])
    return normal + part, gradient + slope


def _amplitude_slopes(
    at_sensors: NDArray[np.float64],
    eigenvalues: NDArray[np.float64],
    k: NDArray[np.int64],
    stiffness: NDArray[np.float64],
    mass: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Derivatives of the logarithm of the motion of modes `k` at the sensors, (P, R).

    Modes that coincide turn into each other at no price; they are left out.
    """
    own = eigenvalues[k]
    gap = own[:, None] - eigenvalues[None, :]
    inverse = gap / (gap**2 + (_EQUAL * own[:, None]) ** 2 + 1e-300)
    coupling = stiffness[:, k, :] - own[:, None] * mass[:, k, :]
    gram = (at_sensors.T @ at_sensors)[k]
    change = np.sum(coupling * inverse * gram, axis=2)
    size = gram[np.arange(k.size), k]
    own_mass = 0.5 * mass[:, k, k] * size
    return np.asarray((change - own_mass) / np.maximum(size, 1e-300))
