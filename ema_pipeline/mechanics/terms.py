"""Matrices as sums of coefficient·v·vᵀ, each coefficient a power of unknowns, so that derivatives are exact."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import (
    Assembly,
    Damper,
    Element,
    Gyroscopic,
    Mass,
    Nonlinear,
    Row,
    Spring,
)

MASS, DAMPING_MATRIX, STIFFNESS, STRUCTURAL = range(4)

K = TypeVar("K")


@dataclass(frozen=True)
class Terms:
    """Matrices as sums of coefficient·v·vᵀ.

    Attributes
    ----------
    dofs : tuple of str
    rows : ndarray, (t, n)
    coefficient : ndarray, (t,)
    matrix : ndarray of int, (t,)
        `MASS`, `DAMPING_MATRIX`, `STIFFNESS` or `STRUCTURAL`.
    log : ndarray, (t, u)
        Derivatives of ln coefficient by the unknown logarithms.
    skew : ndarray, (n, n)
        Skew part of the damping matrix.
    """

    dofs: tuple[str, ...]
    rows: NDArray[np.float64]
    coefficient: NDArray[np.float64]
    matrix: NDArray[np.int64]
    log: NDArray[np.float64]
    skew: NDArray[np.float64]

    @classmethod
    def joined(cls, parts: Sequence[Terms]) -> Terms:
        """All terms of several parts with the same coordinates and unknowns."""
        return cls(
            parts[0].dofs,
            np.concatenate([p.rows for p in parts]),
            np.concatenate([p.coefficient for p in parts]),
            np.concatenate([p.matrix for p in parts]),
            np.concatenate([p.log for p in parts]),
            sum((p.skew for p in parts[1:]), parts[0].skew),
        )

    def damping_scaled(self, factor: NDArray[np.float64]) -> Terms:
        """What is added to the damping matrix where `factor` F, (n, n), makes F C Fᵀ of it."""
        on, rows = self.by_kind[DAMPING_MATRIX]
        signed = np.concatenate([self.coefficient[on], -self.coefficient[on]])
        matrix, log = np.full(len(signed), DAMPING_MATRIX), np.concatenate([self.log[on]] * 2)
        return Terms(
            self.dofs, np.concatenate([rows @ factor.T, rows]), signed, matrix, log, np.zeros_like(self.skew)
        )

    def scaled(self, logs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coefficients at these unknown logarithms, (t,)."""
        return np.asarray(self.coefficient * np.exp(self.log @ logs))

    def dense(self, coefficient: NDArray[np.float64]) -> NDArray[np.float64]:
        """M, C without its skew part, K and the structural part, (4, n, n)."""
        n = len(self.dofs)
        result = np.zeros((4, n, n))
        for kind, (on, v) in self.by_kind.items():
            result[kind] = v.T @ (coefficient[on, None] * v)
        return result

    @cached_property
    def by_kind(self) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Positions and rows of the terms of each kind of matrix that has any."""
        found = {}
        for kind in sorted(set(self.matrix.tolist())):
            on = np.flatnonzero(self.matrix == kind)
            found[kind] = (on, self.rows[on])
        return found


@dataclass(frozen=True)
class Matrices:
    """One configuration's matrices and their derivatives at a point.

    Attributes
    ----------
    terms : Terms
    coefficient : ndarray, (t,)
        Of the terms at this point.
    dense : ndarray, (4, n, n)
    skew : ndarray, (n, n)
    damping_ratio : ndarray, (n,)
        Of every undamped mode, besides the matrices.
    damping_log : ndarray, (u, n)
        Derivatives of its logarithm by the unknowns that it depends on.
    by_shape : ndarray, (k, 4, n, n)
        Derivatives by unknowns that change whole matrices: losses of joints, geometry and effects' sizes.
    skew_by_shape : ndarray, (k, n, n)
    along_modal : tuple of (ndarray, (n, n), ndarray, (u, n))
        Parts of the damping matrix, in coordinates of the undamped modes, that go with the damping ratios of these, and
        the derivatives of the logarithms of their diagonals by the unknowns of `damping_log`; row r and column r go
        with the root.
    """

    terms: Terms
    coefficient: NDArray[np.float64]
    dense: NDArray[np.float64]
    skew: NDArray[np.float64]
    damping_ratio: NDArray[np.float64]
    damping_log: NDArray[np.float64]
    by_shape: NDArray[np.float64]
    skew_by_shape: NDArray[np.float64]
    along_modal: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...] = ()

    @cached_property
    def shaped(self) -> NDArray[np.bool_]:
        """Which kinds of matrices the unknowns of `by_shape` change, (k, 4)."""
        return np.asarray(np.any(self.by_shape, axis=(2, 3)))


def assemble_terms(
    assembly: Assembly,
    dependent: Mapping[K, NDArray[np.float64]],
    key: Callable[[Element], K],
) -> Terms:
    """All elements as terms; nonlinear ones with their tangents.

    Parameters
    ----------
    assembly : Assembly
    dependent : dict to ndarray, (u,)
        Derivatives of ln value by the unknown logarithms, by `key` of an element; elements without an entry are fixed.
    key : callable
        What identifies an element among `dependent`.
    """
    index = {d: i for i, d in enumerate(assembly.dofs)}
    n = len(index)
    count = len(next(iter(dependent.values()))) if dependent else 0
    still = np.zeros(count)
    rows, coefficient, matrix, log = [], [], [], []
    skew = np.zeros((n, n))

    def vector(row: Row) -> NDArray[np.float64]:
        v = np.zeros(n)
        for dof, value in row.items():
            v[index[dof]] = value
        return v

    def add(kind: int, row: Row, value: float, of: NDArray[np.float64]) -> None:
        if value != 0.0:
            rows.append(vector(row))
            coefficient.append(value)
            matrix.append(kind)
            log.append(of)

    for e in assembly.elements:
        of = dependent.get(key(e), still)
        if isinstance(e, Mass):
            add(MASS, e.row, e.value, of)
        elif isinstance(e, Spring):
            add(STIFFNESS, e.row, e.stiffness, of)
            add(STRUCTURAL, e.row, e.stiffness * e.loss_factor, of)
        elif isinstance(e, Damper):
            add(DAMPING_MATRIX, e.row, e.coefficient, of)
        elif isinstance(e, Gyroscopic):
            a, b = vector(e.a), vector(e.b)
            skew += e.coefficient * (np.outer(a, b) - np.outer(b, a))
        elif isinstance(e, Nonlinear):
            add(STIFFNESS, e.row, e.tangent_stiffness, still)
            add(DAMPING_MATRIX, e.row, e.tangent_damping, still)
    return Terms(
        assembly.dofs,
        np.array(rows).reshape(-1, n),
        np.array(coefficient),
        np.array(matrix, np.int64),
        np.array(log).reshape(len(rows), count),
        skew,
    )
