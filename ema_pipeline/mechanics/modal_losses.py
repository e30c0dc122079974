"""Damping matrices that go with the damping ratios of undamped modes: those of dampers, and the losses of joints.

The derivatives take undamped modes for fixed in this.

References
----------
C. D. Johnson, D. A. Kienholz, Finite element prediction of damping in structures with constrained viscoelastic layers,
AIAA Journal 20 (1982) 1284-1290.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.terms import DAMPING_MATRIX, MASS, STIFFNESS, Matrices, Terms

_NEAR = 0.1
"""Half-widths within which two modes count as coinciding. Next to nothing turns them into each other, so that no fit
could follow what is lost in one and not in the other: they are taken to damp alike."""


def slopes_of_own(
    eigenvalues: NDArray[np.float64], ratio: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Derivatives of the logarithms of damping ratios by those of the lowest modes, which are unknowns, (count, n).

    Modes are known by their order. Where two coincide, which one is which is not known, so that both have the mean of
    the two: damping is continuous there.

    Parameters
    ----------
    eigenvalues : ndarray, (n,)
        ω², (rad/s)², in ascending order.
    ratio : ndarray, (n,)
        Damping ratios without what is a mode's own.
    count : int
    """
    return _shares(_nearness(np.sqrt(eigenvalues), ratio))[:count]


def with_dampers_along(
    matrices: Matrices,
    rig: Terms,
    shapes: NDArray[np.float64],
    logs: NDArray[np.float64],
    damping: NDArray[np.float64],
    common: int,
) -> Matrices:
    """The matrices with what dampers of a rig add, where modes have damping ratios of their own.

    It goes with them: row and column r of the dampers' matrix between undamped modes with the root of the factor of
    mode r, which leaves it positive.

    Parameters
    ----------
    matrices : Matrices
    rig : Terms
        Of the rig without effects.
    shapes : ndarray, (n, n)
        Of the undamped modes, mass-normalised.
    logs, damping : ndarray, (v,), (u,)
        Unknowns of the terms, and those of `Matrices.damping_log`.
    common : int
        Number of the latter, the first ones, that all modes share.
    """
    if DAMPING_MATRIX not in rig.by_kind or rig.dofs != matrices.terms.dofs:
        return matrices
    own_log = matrices.damping_log.copy()
    own_log[:common] = 0.0
    root = np.exp(0.5 * (damping @ own_log))
    moved = matrices.dense[MASS] @ shapes
    added = rig.damping_scaled((moved * root) @ shapes.T)
    coefficient = added.scaled(logs)
    on, rows = rig.by_kind[DAMPING_MATRIX]
    along = (rows @ shapes) * root
    dense = matrices.dense.copy()
    dense[DAMPING_MATRIX] += added.dense(coefficient)[DAMPING_MATRIX]
    return replace(
        matrices,
        terms=Terms.joined([matrices.terms, added]),
        coefficient=np.concatenate([matrices.coefficient, coefficient]),
        dense=dense,
        along_modal=(*matrices.along_modal, (along.T @ (coefficient[: len(on), None] * along), own_log)),
    )


def with_joint_losses(
    matrices: Matrices,
    eigenvalues: NDArray[np.float64],
    shapes: NDArray[np.float64],
    joints: NDArray[np.int64],
    log_factor: NDArray[np.float64],
) -> Matrices:
    """The matrices with what joints lose more or less than the others.

    The loss of a mode is that of the parts, each with its share of the strain energy (Johnson & Kienholz). What couples
    modes r and s is that at the geometric mean of both, which leaves damping positive.

    Parameters
    ----------
    matrices : Matrices
        The first of `by_shape`, where there are any, are those of the joints.
    eigenvalues, shapes : ndarray, (n,), (n, n)
        ω², (rad/s)², and mass-normalised shapes of the undamped modes.
    joints : ndarray of int, (j,)
        Positions of the joints' stiffnesses among the unknowns of the terms.
    log_factor : ndarray, (j,)
        Logarithms of the loss of each over that of the others.
    """
    on, omega, ratio = matrices.terms.matrix == STIFFNESS, np.sqrt(eigenvalues), matrices.damping_ratio
    stretch = (matrices.terms.rows[on] @ shapes) * np.sqrt(2 * ratio / omega)
    of_joint = matrices.coefficient[on, None] * matrices.terms.log[on][:, joints]
    usual = np.einsum("tp,ta,tb->pab", of_joint, stretch, stretch, optimize=True)
    near = _nearness(omega, ratio)
    alike = np.diagonal(usual, axis1=1, axis2=2) @ _shares(near)
    usual *= 1 - near
    usual += alike[:, None] * np.eye(len(near))
    factor = np.exp(log_factor)
    added = np.tensordot(factor - 1, usual, 1)
    moved, dense, by_shape = matrices.dense[MASS] @ shapes, matrices.dense.copy(), matrices.by_shape.copy()
    dense[DAMPING_MATRIX] += moved @ added @ moved.T
    if len(by_shape):
        by_shape[: len(factor), DAMPING_MATRIX] = moved @ (factor[:, None, None] * usual) @ moved.T
    along = (*matrices.along_modal, (added, matrices.damping_log))
    return replace(matrices, dense=dense, by_shape=by_shape, along_modal=along)


def _nearness(omega: NDArray[np.float64], ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 where two undamped modes coincide, 0 where they are far apart, (n, n)."""
    half_width = np.maximum(ratio, 1e-9) * omega
    apart = np.subtract.outer(omega, omega) / (_NEAR * np.maximum.outer(half_width, half_width))
    return np.asarray(1 / (1 + apart**4))


def _shares(near: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares of all modes in the mean of those that coincide with each one, a column that adds up to 1, (n, n)."""
    return np.asarray(near / np.sum(near, axis=0))
