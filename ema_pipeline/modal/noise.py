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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ema_pipeline.modal.noise_kernel import quiet_lines, slopes
from ema_pipeline.threads import over_rows

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

    def rows(self, rows: slice) -> Noise:
        """The same for some rows."""
        return Noise(self.common[rows], self.own[rows])

    def weight(self, measured: NDArray[np.bool_]) -> Real:
        """One over variance; 0 where not measured."""
        variance = self.variance
        variance[~(variance > 0)] = 1.0
        np.divide(1.0, variance, out=variance)
        variance[~measured] = 0.0
        return variance

    def mean_log(self) -> Real:
        """Mean logarithm of the variance of every FRF over its lines, (n_rows, n_references)."""
        return np.asarray(np.log(np.maximum(self.variance, 1e-300)).mean(axis=-1))


def second_difference_power(frf: Complex) -> Real:
    """Noise power of every FRF from its second difference over lines, which smooth curves do not pass.

    Returns
    -------
    ndarray, (n_rows, n_references)
        Median over lines, as a variance E|n|².
    """
    difference = np.abs(np.diff(frf, n=2, axis=-1)) ** 2 / 6.0
    return np.asarray(np.median(difference, axis=-1) / np.log(2.0))


def squared(values: Complex) -> Real:
    """|values|², of the same shape."""
    power = np.asarray(np.square(values.real))
    power += np.square(values.imag)
    return power


@dataclass(frozen=True)
class NoiseLaw:
    """The noise model by its parameters: evaluated where it is needed, it takes no memory.

    Attributes
    ----------
    common, shape : ndarray, (n_rows or 1, n_references or 1, n_nodes)
        α and g of each input at the nodes.
    level, floor : ndarray, (n_rows, n_references)
        b, and what is added to it as the least noise.
    hats : ndarray, (n_nodes, n_lines)
    """

    common: Real
    shape: Real
    level: Real
    floor: Real
    hats: Real

    def at(self, response: Complex) -> Noise:
        """Noise of FRFs (n_rows, n_references, n_lines)."""
        return self.at_squares(squared(response))

    def at_squares(self, square: Real) -> Noise:
        """The same for |H|², which is overwritten."""
        own = self.level[..., None] * (self.shape @ self.hats)
        own += self.floor[..., None]
        square *= self.common @ self.hats
        return Noise(square, own)

    def lines(self, first: int, stop: int) -> NoiseLaw:
        """The same on lines ``first:stop``."""
        return replace(self, hats=self.hats[:, first:stop])

    def rows(self, rows: slice) -> NoiseLaw:
        """The same for some rows."""
        per_row = len(self.common) > 1
        return NoiseLaw(
            self.common[rows] if per_row else self.common,
            self.shape[rows] if per_row else self.shape,
            self.level[rows],
            self.floor[rows],
            self.hats,
        )


def flat_law(level: Real, n_lines: int) -> NoiseLaw:
    """A first guess where the scatter over hits is not known: white, (n_rows, n_references), and little in common."""
    return NoiseLaw(
        np.full((1, 1, 1), 1e-4), np.ones((1, 1, 1)), level, np.zeros(level.shape), np.ones((1, n_lines))
    )


def fit_noise(power: Real, response: Complex, measured: NDArray[np.bool_], *, inputs_are_rows: bool) -> Noise:
    """Fit the noise model to squared errors, and evaluate it; as `fit_law`."""
    return fit_law(power, response, measured, inputs_are_rows=inputs_are_rows).at(response)


def fit_law(
    power: Real,
    response: Complex,
    measured: NDArray[np.bool_],
    *,
    inputs_are_rows: bool,
    averaged: NDArray[np.int64] | None = None,
) -> NoiseLaw:
    """Fit the noise model to squared errors; `response` are the FRFs, the rest as for `fit_law_of_squares`.

    Where errors are averages over neighbouring lines, `averaged` tells over how many, (n_rows, n_references): beside a
    narrow peak they hold the noise of the peak, which |H|² of these lines alone would not explain.
    """
    square = np.empty(power.shape)

    def of_rows(rows: slice) -> None:
        square[rows] = squared(response[rows])
        if averaged is not None:
            for values, lines in zip(square[rows], averaged[rows], strict=True):
                for one, n in zip(values, lines.tolist(), strict=True):
                    uniform_filter1d(one, min(n, one.size), output=one, mode="nearest")

    with over_rows(len(power), power.size) as each:
        each(of_rows)
    return fit_law_of_squares(power, square, measured, inputs_are_rows=inputs_are_rows)


def fit_law_of_squares(
    power: Real, square: Real, measured: NDArray[np.bool_], *, inputs_are_rows: bool
) -> NoiseLaw:
    """Fit the noise model to squared errors.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared modulus of the error, or variance from hits; NaN or 0 where unknown.
    square : ndarray, (n_rows, n_references, n_lines)
        |H|² (best of a model, so that the noise of the FRFs does not leak into the weights).
    measured : ndarray of bool, (n_rows, n_references)
    inputs_are_rows : bool
        True for a roving hammer, where rows are inputs.
    """
    n_rows, n_ref, n_lines = power.shape
    starts, spacing = _intervals(n_lines)
    hats = _hats(n_lines)
    n_nodes = len(hats)
    floor, quiet = np.empty((n_rows, n_ref)), np.empty((n_rows, n_ref))
    sums = np.empty((2, n_rows, n_ref, n_nodes))
    group = (n_rows, 1, n_nodes) if inputs_are_rows else (1, n_ref, n_nodes)
    axis = 1 if inputs_are_rows else 0  # the axis that outputs run along

    def begin(rows: slice) -> None:
        quiet_lines(power[rows], square[rows], measured[rows], FLOOR**2, floor[rows], quiet[rows])

    with over_rows(n_rows, power.size) as each:
        each(begin)
        # start: noise of each FRF at its quiet lines; a small common share
        b = 1.78 * np.exp(quiet)
        g, alpha = np.ones(group), np.full(group, 1e-4)

        def derivatives(*, common: bool) -> Real:
            """Of the likelihood by one share of the variance, less and more."""
            full = [np.ascontiguousarray(np.broadcast_to(x, (n_rows, n_ref, n_nodes))) for x in (alpha, g)]

            def work(rows: slice) -> None:
                a, s = full[0][rows], full[1][rows]
                known = power[rows], square[rows], measured[rows], floor[rows]
                slopes(*known, a, s, b[rows], starts, spacing, common, sums[:, rows])

            each(work)
            return sums

        for _ in range(ITERATIONS):
            less, more = derivatives(common=True)
            alpha = alpha * np.sqrt(_total(more, axis) / _total(less, axis))
            less, more = derivatives(common=False)
            g = g * np.sqrt(_total(b[..., None] * more, axis) / _total(b[..., None] * less, axis))
            less, more = derivatives(common=False)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.sum(more * g, axis=-1) / np.sum(less * g, axis=-1)
            b = b * np.sqrt(np.where(np.isfinite(ratio), ratio, 1.0))
    return NoiseLaw(alpha, g, b, floor, hats)


def _total(values: Real, axis: int) -> Real:
    """Sum over outputs; never 0."""
    return np.asarray(np.maximum(values.sum(axis=axis, keepdims=True), 1e-300))


def _hats(n_lines: int) -> Real:
    """Piecewise-linear functions that add up to 1, (n_nodes, n_lines)."""
    n = _n_nodes(n_lines)
    if n == 1:
        return np.ones((1, n_lines))
    nodes = np.linspace(0, n_lines - 1, n)
    x = np.arange(n_lines)
    return np.maximum(0.0, 1.0 - np.abs(x[None] - nodes[:, None]) / (nodes[1] - nodes[0]))


def _n_nodes(n_lines: int) -> int:
    return int(np.clip(n_lines // LINES_PER_NODE, 1, MAX_NODES))


def _intervals(n_lines: int) -> tuple[NDArray[np.int64], float]:
    """First line of every interval between nodes and one past the last line; lines from node to node."""
    n = _n_nodes(n_lines)
    if n == 1:
        return np.array([0, n_lines]), float(n_lines)
    spacing = (n_lines - 1) / (n - 1)
    starts = np.ceil(spacing * np.arange(n)).astype(np.int64)
    starts[-1] = n_lines
    return starts, spacing


def larger(a: Noise, b: Noise) -> Noise:
    """Line by line the noise with the larger variance, in the memory of the first."""
    for common, own, more_common, more_own in zip(a.common, a.own, b.common, b.own, strict=True):
        less = ~(common + own >= more_common + more_own)
        np.copyto(common, more_common, where=less)
        np.copyto(own, more_own, where=less)
    return a
