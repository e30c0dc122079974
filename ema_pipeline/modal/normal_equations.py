"""Least-squares complex frequency-domain models of all orders for the price of the highest.

The right matrix fraction H(ω) = B(z) A(z)⁻¹, z = exp(−jθ(ω)), with real coefficients is fitted to rows of
FRFs in the linear least-squares sense. Eliminating B leaves normal equations in A of every order n,

    M_n = T_n − Σ_rows S_nᵀ R_n⁻¹ S_n .

With one Cholesky factor R = LLᵀ at the highest order and W = L⁻¹S, the sum for order n is over the first
n + 1 rows of W, so that all orders follow from a running sum. R and S are Toeplitz: the rows of L⁻¹ are the
prediction-error filters of R, and W comes one row after the other out of the lattice of these filters, at two
operations per lag, without S ever being formed.

References
----------
Guillaume, Verboven, Vanlanduit, Van der Auweraer & Peeters, "A poly-reference implementation of the
least-squares complex frequency-domain estimator", IMAC XXI, 2003.
Peeters, Van der Auweraer, Guillaume & Leuridan, "The PolyMAX frequency-domain method: a new standard for
modal parameter estimation?", Shock and Vibration 11, 2004.
Makhoul, "Linear prediction: a tutorial review", Proceedings of the IEEE 63, 1975 (lattice).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

Real = NDArray[np.float64]

BLOCK_BYTES = 1 << 20
"""FRFs that are transformed together: they should stay in the cache."""


@dataclass(frozen=True)
class Fraction:
    """Coefficients of one order.

    Attributes
    ----------
    order : int
    denominator : ndarray, (order + 1, n_references, n_references)
        A_k of z^k; A_order is the identity.
    """

    order: int
    denominator: Real


@dataclass(frozen=True)
class NormalEquations:
    """R, S and T of the highest order N.

    Attributes
    ----------
    factor : ndarray, (N + 1, N + 1)
        Lower Cholesky factor of R.
    cross : ndarray, (2N + 1, n_references, n_rows)
        Lags of S: S_jk of a reference and a row at index N − j + k.
    total : ndarray, ((N + 1)·n_references, (N + 1)·n_references)
        T, summed over rows.
    """

    factor: Real
    cross: Real
    total: Real


def normal_equations(
    frf: NDArray[np.complex128],
    weight: Real,
    order: int,
    first_line: int,
    n_grid: int,
    row_scale: Real | None = None,
) -> NormalEquations:
    """Normal equations of the highest order.

    Parameters
    ----------
    frf : complex ndarray, (n_rows, n_references, n_lines)
        Line l lies at θ = π (first_line + l)/n_grid; the last line at most at π.
    weight : ndarray, (n_lines,)
        Squared weight of the lines.
    order : int
    first_line, n_grid : int
    row_scale : ndarray, (n_rows,), optional
        By which each row is divided, a few at a time: no scaled copy of all is made.
    """
    n_rows, n_ref, n_lines = frf.shape
    lines = slice(first_line, first_line + n_lines)
    at_once = min(n_rows, max(1, BLOCK_BYTES // (16 * n_ref * (n_grid + 1))))
    padded = np.zeros((at_once, n_ref, n_grid + 1), dtype=np.complex128)
    cross = np.empty((2 * order + 1, n_ref, n_rows))
    products = np.zeros((n_ref, n_ref, n_grid + 1), dtype=np.complex128)
    for start in range(0, n_rows, at_once):
        block = frf[start : start + at_once]
        if row_scale is not None:
            block = block / row_scale[start : start + at_once, None, None]
        weighted = padded[: len(block)]
        np.multiply(block, weight, out=weighted[..., lines])
        cross[..., start : start + at_once] = _lags(weighted, order)[..., ::-1].transpose(2, 1, 0)
        for i in range(n_ref):
            left, right = block[:, i], weighted[:, i, lines]
            products[i, i, lines] += np.einsum("ol,ol->l", left.real, right.real)
            products[i, i, lines] += np.einsum("ol,ol->l", left.imag, right.imag)
            for k in range(i + 1, n_ref):
                products[i, k, lines] += np.einsum("ol,ol->l", left.conj(), weighted[:, k, lines])
                products[k, i, lines] = products[i, k, lines].conj()
    weights = np.zeros(n_grid + 1, dtype=np.complex128)
    weights[lines] = weight
    r = _lags(weights, order)[order:]
    r[0] *= 1 + 1e-14
    m = np.arange(order + 1)
    power = _lags(products, order)[:, :, order + m[:, None] - m]  # T_jk has lag j − k, as S
    total = power.transpose(2, 0, 3, 1).reshape((order + 1) * n_ref, -1)
    factor = np.asarray(np.linalg.cholesky(scipy.linalg.toeplitz(r)), dtype=np.float64)
    return NormalEquations(factor, cross, total)


def _lags(values: NDArray[np.complex128], order: int) -> Real:
    """2·Re Σ values·exp(jπ l m/n) over lines l = 0 … n, for lags m = −order … order.

    The line at π (and the one at 0) counts half, which makes the functions orthogonal on the half circle.
    """
    length = 2 * (values.shape[-1] - 1)
    full = scipy.fft.irfft(values, n=length, axis=-1)
    return length * np.concatenate([full[..., -order:], full[..., : order + 1]], axis=-1)


def fractions(equations: NormalEquations, orders: list[int]) -> Iterator[Fraction]:
    """Denominators of the given orders, with A_order = I.

    With z = exp(−jθ) and the highest coefficient fixed, poles that only fit noise come out unstable and are
    easily told from physical ones.

    Parameters
    ----------
    equations : NormalEquations
    orders : list of int
        Ascending, from 1 to the order of the equations.
    """
    top, r = len(equations.factor) - 1, equations.cross.shape[1]
    deviation = np.diag(equations.factor)
    unit = np.eye(top + 1)[:, 0]
    reflection = deviation * scipy.linalg.solve_triangular(
        equations.factor, unit, lower=True, check_finite=False
    )
    forward = equations.cross.reshape(-1, equations.cross.shape[2]).copy()
    backward = forward.copy()  # of order n from lag n on, so that it stays in place
    normal = np.array(equations.total, order="F")
    fresh: list[Real] = []
    wanted = set(orders)
    for n in range(orders[-1] + 1):
        if n:
            ahead, behind = forward[: (2 * top + 1 - n) * r], backward[n * r :]
            fed = reflection[n] * ahead
            ahead += reflection[n] * behind
            behind += fed
        fresh.append(forward[(top - n) * r : (2 * top + 1 - n) * r] / deviation[n])
        if n in wanted:
            w = np.concatenate(fresh, axis=1)
            fresh.clear()
            normal = scipy.linalg.blas.dsyrk(
                -1.0, w.T, beta=1.0, c=normal, trans=1, lower=1, overwrite_c=1
            )  # below the diagonal only
            low = _solved(normal[: n * r, : n * r], -normal[n * r : (n + 1) * r, : n * r].T)
            yield Fraction(n, np.concatenate([low.reshape(n, r, r), np.eye(r)[None]]))


def _solved(matrix: Real, right: Real) -> Real:
    """Solution for a symmetric matrix of which the lower triangle is valid."""
    _, low, info = scipy.linalg.lapack.dposv(matrix, right, lower=1)
    if info:
        full = np.tril(matrix) + np.tril(matrix, -1).T
        low = scipy.linalg.lstsq(full, right, check_finite=False)[0]
    return np.asarray(low)


def numerator(equations: NormalEquations, fraction: Fraction) -> Real:
    """B_k of every row for a denominator, (n_rows, order + 1, n_references)."""
    n, (lags, r, n_rows) = fraction.order, equations.cross.shape
    windows = np.lib.stride_tricks.sliding_window_view(
        equations.cross.reshape(lags * r, n_rows), (n + 1) * r, axis=0
    )[::r]
    top = (lags - 1) // 2
    s = windows[top - n : top + 1][::-1]  # (n + 1, n_rows, (n + 1)·n_references)
    stacked = (s @ fraction.denominator.reshape(-1, r)).reshape(n + 1, -1)
    b = scipy.linalg.cho_solve((equations.factor[: n + 1, : n + 1], True), stacked, check_finite=False)
    return np.asarray(b.reshape(n + 1, n_rows, r).transpose(1, 0, 2))
