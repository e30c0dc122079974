"""Close modes compared as a group: the space that they span, and the matrix of the model in it.

Where two modes come close, a part that is off by little turns their shapes into each other, and where they change
places nothing is linear: no descent leads through that point. The matrix of the model between them, in the basis of
the measured shapes, is smooth all the way. Its diagonal is compared with the measured frequencies, and what stands
beside the diagonal is the rotation of the shapes to first order.

References
----------
T. Kato, Perturbation theory for linear operators, 2nd ed., Springer 1976, II.2: what the modes of a group span, and
the matrix there, are analytic where single shapes are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_INDEPENDENT = 0.05
"""Smallest eigenvalue of the correlation of shapes, model's or measured, that are told apart."""


@dataclass(frozen=True)
class Group:
    """The model's modes of one group, seen in the basis of the measured shapes.

    Attributes
    ----------
    log_frequency : ndarray, (c,)
        ln of frequencies in Hz, of the diagonal.
    shapes : ndarray, (c, s)
        What the sensors read of the combination nearest to every measured shape.
    turned : ndarray, (c, s)
        What a rotation adds to it.
    log_frequency_slope, shapes_slope, turned_slope : ndarray, (c, n), (c, s, n), (c, s, n), optional
        Derivatives by all unknowns.
    """

    log_frequency: Real
    shapes: Real
    turned: Real
    log_frequency_slope: Real | None = None
    shapes_slope: Real | None = None
    turned_slope: Real | None = None


@dataclass(frozen=True)
class Slopes:
    """Derivatives of a group's modes by all unknowns.

    Attributes
    ----------
    read : ndarray, (c, s, n)
        Of what the sensors read of every mode, none turned into another one.
    reduced : ndarray, (c, c, n)
        Of the matrix between them.
    measured : ndarray, (c, s, n)
        Of the shapes that are compared, as far as unknowns change them.
    """

    read: Real
    reduced: Real
    measured: Real


def straightened(
    read: Real,
    measured: Real,
    weight: Real,
    frequency_hz: Real,
    measured_hz: Real,
    uncertain: Real,
    slopes: Slopes | None = None,
) -> Group | None:
    """A group of the model's modes in the basis of the measured shapes; None where sensors cannot tell them apart.

    Parameters
    ----------
    read : ndarray, (s, c)
        What the sensors read of the model's modes, mass-normalised.
    measured, weight : ndarray, (c, s)
        Measured shapes, and one over the variance of each entry; 0 where not measured.
    frequency_hz, measured_hz : ndarray, (c,)
    uncertain : ndarray, (c,)
        1 σ of ln f, measured and model.
    slopes : Slopes, optional
    """
    gram = np.einsum("ks,sa,sb->kab", weight, read, read)
    size = np.sqrt(np.maximum(np.einsum("kaa->ka", gram), 1e-300))
    if np.min(np.linalg.eigvalsh(gram / size[:, :, None] / size[:, None, :])) < _INDEPENDENT:
        return None
    inverse = np.linalg.inv(gram)
    share = np.einsum(
        "kab,sb,ks->ka", inverse, read, weight * measured
    )  # of every model mode in a measured one
    length = np.linalg.norm(share, axis=1)
    if np.min(length) <= 0:
        return None
    left, spread, right = np.linalg.svd((share / length[:, None]).T)
    if spread[-1] ** 2 < _INDEPENDENT:
        return None
    basis = left @ right  # orthonormal, (c model, c measured)
    square = (2 * np.pi * frequency_hz) ** 2
    matrix = basis.T @ (square[:, None] * basis)
    own = np.diag(matrix)
    turn = matrix.T * _inverse_distance(measured_hz, uncertain)
    rotated = basis @ turn
    shapes, turned = (read @ basis).T, (read @ rotated).T
    log_frequency = 0.5 * np.log(own) - np.log(2 * np.pi)
    if slopes is None:
        return Group(log_frequency, shapes, turned)

    # basis: the polar factor of the normalised shares
    rest = weight * (measured - share @ read.T)
    pulled = np.einsum("jsn,ks->kjn", slopes.read, rest)
    moved = slopes.measured - np.einsum("kj,jsn->ksn", share, slopes.read)
    pulled += np.einsum("sa,ks,ksn->kan", read, weight, moved)
    share_slope = np.einsum("kab,kbn->kan", inverse, pulled)
    unit = share / length[:, None]
    unit_slope = share_slope - unit[:, :, None] * np.einsum("ka,kan->kn", unit, share_slope)[:, None]
    unit_slope /= length[:, None, None]
    along = np.einsum("ab,kan->bkn", basis, unit_slope)  # (c, c measured, n)
    skew = along - along.transpose(1, 0, 2)
    stretch = spread[:, None] + spread
    inner = np.einsum("ab,bcn,dc->adn", right, skew, right) / stretch[:, :, None]
    turning = np.einsum("ba,bcn,cd->adn", right, inner, right)
    basis_slope = np.einsum("ab,bcn->acn", basis, turning)

    changed = np.einsum("ab,acn,cd->bdn", basis, slopes.reduced, basis)
    changed += np.einsum("ab,bcn->acn", matrix, turning) - np.einsum("abn,bc->acn", turning, matrix)
    turn_slope = changed.transpose(1, 0, 2) * _inverse_distance(measured_hz, uncertain)[:, :, None]
    rotated_slope = np.einsum("abn,bc->acn", basis_slope, turn) + np.einsum("ab,bcn->acn", basis, turn_slope)

    def of_shapes(combination: Real, change: Real) -> Real:
        return np.asarray(
            np.einsum("jk,jsn->ksn", combination, slopes.read) + np.einsum("sj,jkn->ksn", read, change)
        )

    return Group(
        log_frequency,
        shapes,
        turned,
        0.5 * np.einsum("aan->an", changed) / own[:, None],
        of_shapes(basis, basis_slope),
        of_shapes(rotated, rotated_slope),
    )


def _inverse_distance(hz: Real, uncertain: Real) -> Real:
    """One over the distance of the eigenvalues of two measured modes, row less column's; 0 for one and itself.

    (other one, mode): by how much of the other one a mode is turned per entry of the matrix between them.
    """
    square = (2 * np.pi * hz) ** 2
    apart = square[None, :] - square[:, None]
    blurred = (square[None, :] + square[:, None]) * np.hypot(uncertain[None, :], uncertain[:, None])
    return np.asarray(apart / np.maximum(apart**2 + blurred**2, 1e-300))
