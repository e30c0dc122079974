"""Least-squares complex frequency-domain models of all orders for the price of the highest.

The right matrix fraction H(ω) = B(z) A(z)⁻¹, z = exp(−jθ(ω)), with real coefficients is fitted to rows of
FRFs in the linear least-squares sense. Eliminating B leaves normal equations in A of every order n,

    M_n = T_n − Σ_rows S_nᵀ R_n⁻¹ S_n .

With one Cholesky factor R = LLᵀ at the highest order and W = L⁻¹S, the sum for order n is over the first
n + 1 rows of W, so that all orders follow from a running sum.

References
----------
Guillaume, Verboven, Vanlanduit, Van der Auweraer & Peeters, "A poly-reference implementation of the
least-squares complex frequency-domain estimator", IMAC XXI, 2003.
Peeters, Van der Auweraer, Guillaume & Leuridan, "The PolyMAX frequency-domain method: a new standard for
modal parameter estimation?", Shock and Vibration 11, 2004.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

Real = NDArray[np.float64]


BLOCK = 64
"""Rows of a triangular product that are done together."""


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
    """R, W = L⁻¹S per row, T for the highest order.

    Attributes
    ----------
    factor : ndarray, (n + 1, n + 1)
        Lower Cholesky factor of R.
    whitened : ndarray, (n + 1, n_rows, (n + 1)·n_references)
        Row k of W, of every row of FRFs.
    total : ndarray, ((n + 1)·n_references, (n + 1)·n_references)
        T, summed over rows.
    n_references : int
    """

    factor: Real
    whitened: Real
    total: Real
    n_references: int


def _lags(values: NDArray[np.complex128], first_line: int, n_grid: int, order: int) -> Real:
    """2·Re Σ values·exp(jπ l m/n_grid) over lines l from `first_line`, for lags m = −order … order.

    The line at π (and the one at 0) counts half, which makes the functions orthogonal on the half circle.
    """
    padded = np.zeros((*values.shape[:-1], n_grid + 1), dtype=values.dtype)
    padded[..., first_line : first_line + values.shape[-1]] = values
    full = scipy.fft.irfft(padded, n=2 * n_grid, axis=-1) * (2 * n_grid)
    return np.concatenate([full[..., -order:], full[..., : order + 1]], axis=-1)


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
    n_ref = frf.shape[1]
    m = np.arange(order + 1)
    back = order + m[:, None] - m[None, :]  # index of lag j − k
    r = _lags(weight.astype(np.complex128), first_line, n_grid, order)[back]
    r[np.diag_indices_from(r)] *= 1 + 1e-14
    factor = np.linalg.cholesky(r)
    s_lags = np.ascontiguousarray(_lags(frf * weight, first_line, n_grid, order).transpose(0, 2, 1))
    s = np.empty((order + 1, len(frf), order + 1, n_ref))
    for j in range(order + 1):  # conj(z^j) z^k has lag j − k because z = exp(−jθ)
        s[j] = s_lags[:, j : j + order + 1][:, ::-1]
    whitened = _solve_lower(factor, s.reshape(order + 1, -1)).reshape(order + 1, len(frf), -1)
    cross = np.einsum("oaf,obf->abf", frf.conj(), frf * weight)
    t = _lags(cross, first_line, n_grid, order)[:, :, back]
    total = t.transpose(2, 0, 3, 1).reshape((order + 1) * n_ref, (order + 1) * n_ref)
    return NormalEquations(factor, whitened, total, n_ref)


def _solve_lower(factor: Real, right: Real) -> Real:
    """L⁻¹ times a wide matrix, in blocks of rows."""
    if np.count_nonzero(factor - np.diag(np.diag(factor))) == 0:
        right /= np.diag(factor)[:, None]
        return right
    inverse = scipy.linalg.solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False)
    out = np.empty_like(right)
    for start in range(0, len(factor), BLOCK):
        stop = min(start + BLOCK, len(factor))
        np.matmul(inverse[start:stop, :stop], right[:stop], out=out[start:stop])
    return out


def increments(equations: NormalEquations, orders: list[int]) -> list[Real]:
    """What the sum over rows of Sᵀ R⁻¹ S gains from each order to the next; they add up over sets of rows.

    Only the upper triangles are filled.
    """
    out, done = [], 0
    for n in orders:
        fresh = equations.whitened[done : n + 1].reshape(-1, equations.total.shape[0])
        out.append(scipy.linalg.blas.dsyrk(1.0, fresh.T, lower=1).T)
        done = n + 1
    return out


def fractions(total: Real, gains: list[Real], orders: list[int], n_references: int) -> Iterator[Fraction]:
    """Denominators of the given orders, with A_order = I.

    With z = exp(−jθ) and the highest coefficient fixed, poles that only fit noise come out unstable and are
    easily told from physical ones.

    Parameters
    ----------
    total : ndarray
        T of the highest order.
    gains : list of ndarray
        From `increments` for the same orders.
    orders : list of int
        Ascending.
    n_references : int
    """
    r = n_references
    accumulated = np.zeros_like(total)
    for n, gain in zip(orders, gains, strict=True):
        accumulated += gain
        size, lead = (n + 1) * r, n * r
        m = total[:size, :size] - accumulated[:size, :size]
        a, b = m[:lead, :lead], -m[:lead, lead:]
        try:
            low = scipy.linalg.cho_solve(
                scipy.linalg.cho_factor(a, lower=False, check_finite=False), b, check_finite=False
            )
        except np.linalg.LinAlgError:
            a = np.triu(a) + np.triu(a, 1).T
            low = np.asarray(scipy.linalg.lstsq(a, b, check_finite=False)[0])
        yield Fraction(n, np.concatenate([low.reshape(n, r, r), np.eye(r)[None]]))


def numerator(equations: NormalEquations, fraction: Fraction) -> Real:
    """B_k of every row for a denominator, (n_rows, order + 1, n_references)."""
    n, r = fraction.order, equations.n_references
    a = fraction.denominator.reshape((n + 1) * r, r)
    stacked = (equations.whitened[: n + 1, :, : (n + 1) * r] @ a).reshape(n + 1, -1)
    b = scipy.linalg.solve_triangular(
        equations.factor[: n + 1, : n + 1], stacked, lower=True, trans="T", check_finite=False
    )
    return np.asarray(b.reshape(n + 1, -1, r).transpose(1, 0, 2))
