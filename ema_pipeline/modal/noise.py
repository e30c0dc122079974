"""Noise of the FRFs over frequency, from the scatter over hits and from what the fit leaves over.

Noise on the force multiplies all FRFs of a hit by one common random factor; noise on a response adds its own.
So the variance of an FRF is modelled as

    v_oi(f) = α_i(f)·|H_oi(f)|² + b_oi·g_i(f) ,

with α and g piecewise linear in frequency (i: the input, o: the output). The maximum-likelihood fit for
exponentially distributed power has simple multiplicative updates that keep everything positive.

References
----------
Févotte, Bertin & Durrieu, "Nonnegative matrix factorization with the Itakura–Saito divergence",
Neural Computation 21, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

LINES_PER_NODE = 60
MAX_NODES = 12
ITERATIONS = 25

FLOOR = 1e-6
"""Relative noise amplitude that no measurement chain undercuts; keeps weights finite for noise-free data."""


@dataclass(frozen=True)
class Noise:
    """Variance of every FRF.

    Attributes
    ----------
    common : ndarray, (n_rows, n_references, n_lines)
        Share that all outputs of one input have in common, α·|H|².
    own : ndarray, (n_rows, n_references, n_lines)
        Share of the response, b·g.
    """

    common: Real
    own: Real

    @property
    def variance(self) -> Real:
        """Sum of both shares."""
        return np.asarray(self.common + self.own)

    def lines(self, first: int, stop: int) -> Noise:
        """The same on lines ``first:stop``."""
        return Noise(self.common[..., first:stop], self.own[..., first:stop])

    def weight(self, measured: NDArray[np.bool_]) -> Real:
        """One over variance; 0 where not measured."""
        return np.where(measured[..., None], 1.0 / np.where(self.variance > 0, self.variance, 1.0), 0.0)


def second_difference_power(frf: Complex) -> Real:
    """Noise power of every FRF from its second difference over lines, which smooth curves do not pass.

    Returns
    -------
    ndarray, (n_rows, n_references)
        Median over lines, as a variance E|n|².
    """
    difference = np.abs(np.diff(frf, n=2, axis=-1)) ** 2 / 6.0
    return np.asarray(np.median(difference, axis=-1) / np.log(2.0))


def fit_noise(power: Real, response: Complex, measured: NDArray[np.bool_], *, inputs_are_rows: bool) -> Noise:
    """Fit the noise model to squared errors.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared modulus of the error, or variance from hits; NaN where unknown.
    response : complex ndarray, (n_rows, n_references, n_lines)
        The FRFs themselves (best from a model, so that their noise does not leak into the weights).
    measured : ndarray of bool, (n_rows, n_references)
    inputs_are_rows : bool
        True for a roving hammer, where rows are inputs.
    """
    n_lines = power.shape[-1]
    hats = _hats(n_lines)
    square = np.abs(response) ** 2
    known = measured[..., None] & np.isfinite(power)
    mask = known.astype(float)
    floor = FLOOR**2 * np.where(measured, np.mean(square, axis=-1), 1.0)[..., None]
    z = np.where(known, np.maximum(np.where(known, power, 1.0), floor), 1.0)
    axis = 1 if inputs_are_rows else 0  # the axis that outputs run along
    # start: noise of each FRF at its quiet lines; a small common share
    with np.errstate(divide="ignore", invalid="ignore"):
        own_level = np.exp(np.sum(mask * np.log(z), axis=-1) / np.maximum(mask.sum(axis=-1), 1)) * 1.78
    own_level = np.where(own_level > 0, own_level, 1.0)
    group_shape = (z.shape[0], 1) if inputs_are_rows else (1, z.shape[1])
    g = np.ones((*group_shape, len(hats)))
    alpha = np.full((*group_shape, len(hats)), 1e-4)
    b = own_level
    for _ in range(ITERATIONS):
        own = b[..., None] * (g @ hats)
        v = (alpha @ hats) * square + own + floor
        first, second = mask / v, mask * z / v**2
        alpha = alpha * np.sqrt(_collect(second * square, hats, axis) / _collect(first * square, hats, axis))
        v = (alpha @ hats) * square + own + floor
        first, second = mask / v, mask * z / v**2
        g = g * np.sqrt(
            _collect(second * b[..., None], hats, axis) / _collect(first * b[..., None], hats, axis)
        )
        shape = g @ hats
        own = b[..., None] * shape
        v = (alpha @ hats) * square + own + floor
        first, second = mask / v, mask * z / v**2
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sum(second * shape, axis=-1) / np.sum(first * shape, axis=-1)
        b = b * np.sqrt(np.where(np.isfinite(ratio), ratio, 1.0))
    return Noise((alpha @ hats) * square, b[..., None] * (g @ hats) + floor)


def _collect(values: Real, hats: Real, axis: int) -> Real:
    """Sum over outputs and, with hat weights, over lines; never 0."""
    return np.asarray(np.maximum(values.sum(axis=axis, keepdims=True) @ hats.T, 1e-300))


def _hats(n_lines: int) -> Real:
    """Piecewise-linear functions that add up to 1, (n_nodes, n_lines)."""
    n = int(np.clip(n_lines // LINES_PER_NODE, 1, MAX_NODES))
    if n == 1:
        return np.ones((1, n_lines))
    nodes = np.linspace(0, n_lines - 1, n)
    x = np.arange(n_lines)
    return np.maximum(0.0, 1.0 - np.abs(x[None] - nodes[:, None]) / (nodes[1] - nodes[0]))


def larger(a: Noise, b: Noise) -> Noise:
    """Line by line the noise with the larger variance."""
    pick = a.variance >= b.variance
    return Noise(np.where(pick, a.common, b.common), np.where(pick, a.own, b.own))
