"""The compiled loops of `close_modes`: groups of a few modes each, for which array operations are mostly overhead."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_INDEPENDENT = 0.05
"""Smallest eigenvalue of the correlation of shapes, model's or measured, that are told apart."""
_SWEEPS, _ROUNDING = 12, 1e-15


class Seen(NamedTuple):
    """Groups in the basis of the measured shapes; 0 for those that sensors do not tell apart.

    Attributes
    ----------
    told_apart : ndarray of bool, (g,)
    inverse : ndarray, (g, k, c, c)
        Of the Gram matrix of what the sensors read, weighed by those of every measured mode.
    share, unit : ndarray, (g, k, c)
        How much of every model mode a measured one holds, and the same of length 1.
    length : ndarray, (g, k)
    spread, axes : ndarray, (g, c), (g, c, c)
        Singular values of the unit shares, and in columns the right singular vectors.
    basis : ndarray, (g, c, k)
        The orthonormal basis nearest to the measured shapes.
    matrix : ndarray, (g, k, k)
        Of the model, (rad/s)².
    distance : ndarray, (g, k, k)
        By how much of the other one a measured mode is turned per entry of the matrix between them: one over the
        distance of their eigenvalues, less where that is uncertain; other one, mode.
    log_frequency : ndarray, (g, k)
        ln of frequencies in Hz, of the diagonal.
    shapes : ndarray, (g, k, s)
        What the sensors read of the combination nearest to every measured shape.
    turned : ndarray, (g, k, s)
        What a rotation adds to it.
    """

    told_apart: NDArray[np.bool_]
    inverse: Real
    share: Real
    unit: Real
    length: Real
    spread: Real
    axes: Real
    basis: Real
    matrix: Real
    distance: Real
    log_frequency: Real
    shapes: Real
    turned: Real


@numba.njit(cache=True)
def _diagonal(matrix, values, axes):  # type: ignore[no-untyped-def]
    """Eigenvalues and, in columns, eigenvectors of a symmetric matrix of a few rows, which is overwritten: Jacobi."""
    n = len(matrix)
    for i in range(n):
        for j in range(n):
            axes[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        left = True
        for p in range(n - 1):
            for q in range(p + 1, n):
                beside = matrix[p, q]
                if abs(beside) <= _ROUNDING * np.sqrt(abs(matrix[p, p] * matrix[q, q])):
                    continue
                left = False
                half = 0.5 * (matrix[q, q] - matrix[p, p]) / beside
                t = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
                t = t if half >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for i in range(n):
                    a, b = matrix[i, p], matrix[i, q]
                    matrix[i, p], matrix[i, q] = c * a - s * b, s * a + c * b
                for i in range(n):
                    a, b = matrix[p, i], matrix[q, i]
                    matrix[p, i], matrix[q, i] = c * a - s * b, s * a + c * b
                    a, b = axes[i, p], axes[i, q]
                    axes[i, p], axes[i, q] = c * a - s * b, s * a + c * b
        if left:
            break
    for i in range(n):
        values[i] = matrix[i, i]


@numba.njit(cache=True)
def _inverted(matrix, inverse):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric, positive matrix of a few rows, which is overwritten: Gauss and Jordan."""
    n = len(matrix)
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    for p in range(n):
        pivot = 1.0 / matrix[p, p]
        for j in range(n):
            matrix[p, j] *= pivot
            inverse[p, j] *= pivot
        for i in range(n):
            if i == p:
                continue
            factor = matrix[i, p]
            for j in range(n):
                matrix[i, j] -= factor * matrix[p, j]
                inverse[i, j] -= factor * inverse[p, j]


@numba.njit(cache=True)
def seen(read, measured, weight, frequency_hz, measured_hz, uncertain):  # type: ignore[no-untyped-def]
    """See `Seen`; arguments are attributes of `close_modes.Groups`."""
    groups, sensors, c = read.shape
    told = np.zeros(groups, np.bool_)
    inverse = np.zeros((groups, c, c, c))
    share, unit = np.zeros((groups, c, c)), np.zeros((groups, c, c))
    length, spread, axes = np.zeros((groups, c)), np.zeros((groups, c)), np.zeros((groups, c, c))
    basis, matrix = np.zeros((groups, c, c)), np.zeros((groups, c, c))
    distance, log_frequency = np.zeros((groups, c, c)), np.zeros((groups, c))
    shapes, turned = np.zeros((groups, c, sensors)), np.zeros((groups, c, sensors))
    gram, alike, root, vectors = np.zeros((c, c)), np.zeros((c, c)), np.zeros((c, c)), np.zeros((c, c))
    values, pulled = np.zeros(c), np.zeros(c)
    for g in range(groups):
        independent = True
        for k in range(c):
            for a in range(c):
                pulled[a] = 0.0
                for s in range(sensors):
                    pulled[a] += weight[g, k, s] * read[g, s, a] * measured[g, k, s]
                for b in range(a + 1):
                    total = 0.0
                    for s in range(sensors):
                        total += weight[g, k, s] * read[g, s, a] * read[g, s, b]
                    gram[a, b] = gram[b, a] = total
            for a in range(c):
                for b in range(c):
                    size = np.sqrt(max(gram[a, a], 1e-300)) * np.sqrt(max(gram[b, b], 1e-300))
                    alike[a, b] = gram[a, b] / size
            _diagonal(alike, values, vectors)
            independent = independent and values.min() > _INDEPENDENT
            if not independent:
                break
            _inverted(gram, inverse[g, k])
            square = 0.0
            for a in range(c):
                for b in range(c):
                    share[g, k, a] += inverse[g, k, a, b] * pulled[b]
                square += share[g, k, a] ** 2
            length[g, k] = np.sqrt(square)
            for a in range(c):
                unit[g, k, a] = share[g, k, a] / max(length[g, k], 1e-300)
        if not independent or length[g].min() <= 0.0:
            continue
        for k in range(c):
            for i in range(c):
                alike[k, i] = 0.0
                for a in range(c):
                    alike[k, i] += unit[g, k, a] * unit[g, i, a]
        _diagonal(alike, values, axes[g])
        if not values.min() > _INDEPENDENT:
            continue
        told[g] = True
        for k in range(c):
            spread[g, k] = np.sqrt(values[k])
        for k in range(c):
            for i in range(c):
                root[k, i] = 0.0
                for j in range(c):
                    root[k, i] += axes[g, k, j] * axes[g, i, j] / spread[g, j]
        for a in range(c):
            for k in range(c):
                for i in range(c):
                    basis[g, a, k] += unit[g, i, a] * root[i, k]
        for k in range(c):
            for i in range(c):
                for a in range(c):
                    matrix[g, k, i] += basis[g, a, k] * (2 * np.pi * frequency_hz[g, a]) ** 2 * basis[g, a, i]
                one, other = (2 * np.pi * measured_hz[g, i]) ** 2, (2 * np.pi * measured_hz[g, k]) ** 2
                blurred = (one + other) * np.hypot(uncertain[g, i], uncertain[g, k])
                distance[g, k, i] = (one - other) / max((one - other) ** 2 + blurred**2, 1e-300)
        for k in range(c):
            log_frequency[g, k] = 0.5 * np.log(matrix[g, k, k]) - np.log(2 * np.pi)
            for s in range(sensors):
                for a in range(c):
                    shapes[g, k, s] += read[g, s, a] * basis[g, a, k]
        for k in range(c):
            for i in range(c):
                turn = matrix[g, i, k] * distance[g, i, k]
                for s in range(sensors):
                    turned[g, k, s] += shapes[g, i, s] * turn
    return Seen(
        told, inverse, share, unit, length, spread, axes, basis, matrix, distance, log_frequency, shapes, turned
    )  # fmt: skip


@numba.njit(cache=True)
def add_slopes(  # type: ignore[no-untyped-def]
    at, read, measured, weight, members, reduced, between, mixed, along, log_frequency, shapes, turned
):
    """Turn derivatives of single modes, by n unknowns, into those of the groups that they are members of.

    Parameters
    ----------
    at : Seen
        All of them told apart.
    read, measured, weight : ndarray
        See `close_modes.Groups`.
    members : ndarray of int, (g, c)
        Places of the modes among all.
    reduced : ndarray, (n_pairs, n_model)
        Derivatives of the matrix between two modes of a group, by the model's unknowns, which come first.
    between : ndarray of int, (m, m)
        Row of each pair in it.
    mixed : ndarray of int, (q, 2)
        Mode and unknown of what the measured shapes are less.
    along : ndarray, (q, s)
        Of what, per unit of the unknown.
    log_frequency : ndarray, (m, n)
    shapes : ndarray, (m, s, n)
        Both overwritten.
    turned : ndarray, (m, s, n)
        Zeros; filled in.
    """
    groups, sensors, c = read.shape
    n, model = log_frequency.shape[1], reduced.shape[1]
    own = np.zeros((c, sensors, n))
    share, inner, half = np.zeros((c, c, n)), np.zeros((c, c, n)), np.zeros((c, c, n))
    turning, changed = np.zeros((c, c, n)), np.zeros((c, c, n))
    moved, rotated = np.zeros((c, c, n)), np.zeros((c, c, n))
    for g in range(groups):
        basis, matrix, distance = at.basis[g], at.matrix[g], at.distance[g]
        for b in range(c):
            for s in range(sensors):
                for j in range(n):
                    own[b, s, j] = shapes[members[g, b], s, j]
        # the shares of all modes in the measured shapes
        _clear(half)
        _clear(share)
        for k in range(c):
            for s in range(sensors):
                w = weight[g, k, s]
                if w == 0.0:
                    continue
                rest = measured[g, k, s]
                for a in range(c):
                    rest -= at.share[g, k, a] * read[g, s, a]
                for a in range(c):
                    for b in range(c):
                        factor = -read[g, s, a] * at.share[g, k, b] + (rest if a == b else 0.0)
                        _add(half[k, a], w * factor, own[b, s])
            for q in range(len(mixed)):
                if mixed[q, 0] == members[g, k]:
                    for a in range(c):
                        for s in range(sensors):
                            half[k, a, mixed[q, 1]] -= weight[g, k, s] * read[g, s, a] * along[q, s]
            for a in range(c):
                for b in range(c):
                    _add(share[k, a], at.inverse[g, k, a, b], half[k, b])
        # along their units, and of these the rotation of the nearest basis
        _clear(inner)
        for k in range(c):
            for a in range(c):
                for i in range(c):
                    factor = basis[a, i]
                    for b in range(c):
                        factor -= basis[b, i] * at.unit[g, k, b] * at.unit[g, k, a]
                    factor /= at.length[g, k]
                    _add(inner[i, k], factor, share[k, a])
                    _add(inner[k, i], -factor, share[k, a])
        axes, spread = at.axes[g], at.spread[g]
        _between(axes, inner, half, turning)
        for i in range(c):
            for k in range(c):
                for j in range(n):
                    inner[i, k, j] = turning[i, k, j] / (spread[i] + spread[k])
        _between(axes.T.copy(), inner, half, turning)
        # the matrix between the modes, in the turning basis
        for a in range(c):
            for b in range(c):
                row = between[members[g, a], members[g, b]]
                for j in range(n):
                    inner[a, b, j] = reduced[row, j] if j < model else 0.0
        _between(basis, inner, half, changed)
        _add_times(matrix, turning, changed)
        _add_by(turning, -matrix, changed)
        # and what the sensors read of it
        turn = matrix * distance
        for k in range(c):
            for i in range(c):
                for j in range(n):
                    inner[k, i, j] = distance[k, i] * changed[k, i, j]
        _clear(moved)
        _clear(rotated)
        _add_times(basis, turning, moved)
        _add_times(basis, inner, rotated)
        _add_by(moved, turn, rotated)
        for k in range(c):
            m = members[g, k]
            for j in range(n):
                log_frequency[m, j] = 0.5 * changed[k, k, j] / matrix[k, k]
            for s in range(sensors):
                for j in range(n):
                    shapes[m, s, j] = 0.0
            for a in range(c):
                held = 0.0
                for i in range(c):
                    held += basis[a, i] * turn[i, k]
                for s in range(sensors):
                    here = read[g, s, a]
                    for j in range(n):
                        shapes[m, s, j] += basis[a, k] * own[a, s, j] + here * moved[a, k, j]
                        turned[m, s, j] += held * own[a, s, j] + here * rotated[a, k, j]


@numba.njit(cache=True)
def _clear(array):  # type: ignore[no-untyped-def]
    """Zeros into an array of three axes."""
    for a in range(array.shape[0]):
        for b in range(array.shape[1]):
            for j in range(array.shape[2]):
                array[a, b, j] = 0.0


@numba.njit(cache=True)
def _add(result, factor, what):  # type: ignore[no-untyped-def]
    """Add an array times a factor to another one."""
    for j in range(len(result)):
        result[j] += factor * what[j]


@numba.njit(cache=True)
def _between(basis, inner, half, result):  # type: ignore[no-untyped-def]
    """basisᵀ·inner·basis for a matrix of arrays, (c, c, n), into `result`; `half` is overwritten."""
    _clear(half)
    _clear(result)
    _add_by(inner, basis, half)
    _add_times(basis.T.copy(), half, result)


@numba.njit(cache=True)
def _add_times(matrix, arrays, result):  # type: ignore[no-untyped-def]
    """Add Σ_b matrix_ab arrays_bk, a matrix of arrays as the others are, (c, c, n)."""
    c = len(matrix)
    for a in range(c):
        for k in range(c):
            for b in range(c):
                _add(result[a, k], matrix[a, b], arrays[b, k])


@numba.njit(cache=True)
def _add_by(arrays, matrix, result):  # type: ignore[no-untyped-def]
    """Add Σ_b arrays_ab matrix_bk."""
    c = len(matrix)
    for a in range(c):
        for k in range(c):
            for b in range(c):
                _add(result[a, k], matrix[b, k], arrays[a, b])
