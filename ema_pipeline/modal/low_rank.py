"""Matrices of low rank that fit weighted complex data best, and what small changes of them can reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

STEADY = 1e-9
"""Share of the weight of a row that is added to its normal equations: rows without data stay finite."""

SAME_DIRECTION = 1e-10
"""Eigenvalue over the largest below which a direction of the tangent space is a combination of the others."""


def low_rank(values: Complex, weight: Real, start: Complex, steps: int) -> tuple[Complex, Complex]:
    """Factors of the matrix of a given rank that fits best, by alternating least squares.

    Parameters
    ----------
    values : complex ndarray, (n_rows, n_columns)
    weight : ndarray, (n_rows, n_columns)
        Inverse variances; 0 where nothing is known.
    start : complex ndarray, (rank, n_columns)
        First guess of the right factor.
    steps : int

    Returns
    -------
    left : complex ndarray, (n_rows, rank)
    right : complex ndarray, (rank, n_columns)
    """
    right = start
    for _ in range(steps):
        left = np.linalg.qr(_rows(values, weight, right))[0]
        right = _rows(values.T, weight.T, left.T).T
    return left, right


def first_right(values: Complex, rank: int) -> Complex:
    """Right singular vectors of the largest singular values, (rank, n_columns)."""
    return np.asarray(np.linalg.svd(values, full_matrices=False)[2][:rank])


def tangent(left: Complex, right: Complex, root_weight: Real) -> Complex:
    """Orthonormal basis of what small changes of both factors add to the weighted product, (n_cells, n_directions).

    Parameters
    ----------
    left : complex ndarray, (n_rows, rank)
    right : complex ndarray, (rank, n_columns)
    root_weight : ndarray, (n_rows, n_columns)
    """
    (n_rows, rank), n_columns = left.shape, right.shape[1]
    of_right = left[:, None, :, None] * np.eye(n_columns)[None, :, None, :]
    of_left = np.eye(n_rows)[:, None, :, None] * right.T[None, :, None, :]
    cells = n_rows * n_columns
    columns = np.concatenate(
        [of_right.reshape(cells, rank * n_columns), of_left.reshape(cells, n_rows * rank)], axis=1
    )
    columns = columns * root_weight.reshape(-1, 1)
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    size, vectors = np.linalg.eigh(columns.conj().T @ columns)
    apart = size > SAME_DIRECTION * size[-1]
    return np.asarray(columns @ (vectors[:, apart] / np.sqrt(size[apart])))


def _rows(values: Complex, weight: Real, right: Complex) -> Complex:
    """Combination of the rows of `right` that fits each row of the values best, (n_rows, rank)."""
    weighted = weight[:, None, :] * right.conj()
    gram = weighted @ right.T
    trace = np.trace(gram, axis1=1, axis2=2).real
    gram = gram + (STEADY * trace + 1e-300)[:, None, None] * np.eye(len(right))
    return np.asarray(np.linalg.solve(gram, weighted @ values[..., None])[..., 0])
