"""Least-squares complex frequency-domain models of all orders for the price of the highest.

The right matrix fraction H(ω) = B(z) A(z)⁻¹, z = exp(−jθ(ω)), with real coefficients is fitted to rows of
FRFs in the linear least-squares sense. Eliminating B leaves normal equations in A of every order n,

    M_n = T_n − Σ_rows S_nᵀ R_n⁻¹ S_n ,

with R, S and T Toeplitz: they are kept as their lags, and no more of them is ever formed. By the
Gohberg–Semencul formula for the inverse of R, M_n changes along its diagonals by

    M_n[a + 1, b + 1] − M_n[a, b] = Σ_rows (e_n[a] e_n[b] − g_n[a] g_n[b]) / E_n ,

where e_n and g_n are the forward and backward prediction errors that the lattice filter of R makes of the lags
of S, at a few operations per lag from each order to the next.

References
----------
Guillaume, Verboven, Vanlanduit, Van der Auweraer & Peeters, "A poly-reference implementation of the
least-squares complex frequency-domain estimator", IMAC XXI, 2003.
Peeters, Van der Auweraer, Guillaume & Leuridan, "The PolyMAX frequency-domain method: a new standard for
modal parameter estimation?", Shock and Vibration 11, 2004.
Kailath & Sayed, "Displacement structure: theory and applications", SIAM Review 37, 1995.
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
    """R, S and T of the highest order N, by their lags.

    Attributes
    ----------
    factor : ndarray, (N + 1, N + 1)
        Lower Cholesky factor of R.
    cross : ndarray, (2N + 1, n_references, n_rows)
        S_jk of row and reference at index N − j + k.
    power : ndarray, (n_references, (N + 1)·n_references)
        First block row of T, summed over rows.
    """

    factor: Real
    cross: Real
    power: Real


def normal_equations(
    frf: NDArray[np.complex128], weight: Real, order: int, first_line: int, n_grid: int
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
    """
    n_rows, n_ref, n_lines = frf.shape
    lines = slice(first_line, first_line + n_lines)
    at_once = min(n_rows, max(1, BLOCK_BYTES // (16 * n_ref * (n_grid + 1))))
    padded = np.zeros((at_once, n_ref, n_grid + 1), dtype=np.complex128)
    cross = np.empty((2 * order + 1, n_ref, n_rows))
    products = np.zeros((n_ref, n_ref, n_grid + 1), dtype=np.complex128)
    for start in range(0, n_rows, at_once):
        block = frf[start : start + at_once]
        weighted = padded[: len(block)]
        np.multiply(block, weight, out=weighted[..., lines])
        cross[..., start : start + at_once] = _lags(weighted, order)[..., ::-1].transpose(2, 1, 0)
        for i in range(n_ref):
            for k in range(i, n_ref):
                products[i, k, lines] += _product(block[:, i], weighted[:, k, lines])
    weights = np.zeros(n_grid + 1, dtype=np.complex128)
    weights[lines] = weight
    r = _lags(weights, order)[order:]
    r[0] *= 1 + 1e-14
    power = _lags(products, order)
    below = np.tril_indices(n_ref, -1)
    power[below] = power.transpose(1, 0, 2)[below][:, ::-1]
    first = power[..., order::-1].transpose(0, 2, 1).reshape(n_ref, -1)
    factor = np.asarray(np.linalg.cholesky(scipy.linalg.toeplitz(r)), dtype=np.float64)
    return NormalEquations(factor, cross, first)


def _product(left: NDArray[np.complex128], right: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Σ_rows conj(left)·right, (n_lines,)."""
    parts = [
        np.einsum("ol,ol->l", a, b)
        for a, b in (
            (left.real, right.real), (left.imag, right.imag), (left.real, right.imag), (left.imag, right.real)
        )
    ]  # fmt: skip
    return np.asarray(parts[0] + parts[1] + 1j * (parts[2] - parts[3]))


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
    gained = np.zeros((r, (top + 1) * r))
    wanted = set(orders)
    for n in range(orders[-1] + 1):
        if n:
            ahead, behind = forward[: (2 * top + 1 - n) * r], backward[n * r :]
            fed = reflection[n] * ahead
            ahead += reflection[n] * behind
            behind += fed
        row = forward[(top - n) * r : (2 * top + 1 - n) * r]
        gained += (row[:r] @ row.T) / deviation[n] ** 2
        if n in wanted:
            m = _normal_matrix(
                equations.power[:, : (n + 1) * r] - gained[:, : (n + 1) * r],
                forward[(top - n) * r : top * r],
                backward[(top + 1) * r : (top + 1 + n) * r],
                1 / deviation[n] ** 2,
            )
            low = _solved(m[: n * r, : n * r], -m[: n * r, n * r :])
            yield Fraction(n, np.concatenate([low.reshape(n, r, r), np.eye(r)[None]]))


def _normal_matrix(first: Real, forward: Real, backward: Real, scale: float) -> Real:
    """M from its first block row and the changes along its diagonals; only its upper triangle is filled."""
    r, width = first.shape
    change = scipy.linalg.blas.dsyrk(scale, forward.T, trans=1, lower=1)
    change = scipy.linalg.blas.dsyrk(-scale, backward.T, trans=1, lower=1, beta=1.0, c=change, overwrite_c=1)
    # each row of blocks read one block further on: what lies on one diagonal then lies in one column
    skewed = np.zeros((width // r, r * (width + 1)))
    m = skewed.reshape(-1)[: width * width].reshape(width, width)
    m[:r] = first
    m[r:, r:] = change.T
    np.cumsum(skewed[:, : r * width], axis=0, out=skewed[:, : r * width])
    return m


def _solved(matrix: Real, right: Real) -> Real:
    """Solution for a symmetric matrix of which the upper triangle is given."""
    _, low, info = scipy.linalg.lapack.dposv(matrix.T, right, lower=1)
    if info:
        full = np.triu(matrix) + np.triu(matrix, 1).T
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
