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

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_INDEPENDENT = 0.05
"""Smallest eigenvalue of the correlation of shapes, model's or measured, that are told apart."""


@dataclass(frozen=True)
class Slopes:
    """Derivatives of what groups of the same size are made of, by all unknowns.

    Attributes
    ----------
    read : ndarray, (g, c, s, n)
        Of what the sensors read of every mode, none turned into another one.
    reduced : ndarray, (g, c, c, n)
        Of the matrix between them.
    measured : ndarray, (g, c, s, n)
        Of the shapes that are compared, as far as unknowns change them.
    """

    read: Real
    reduced: Real
    measured: Real


@dataclass(frozen=True)
class Turned:
    """Derivatives of a `Groups`' attributes of the same names, with n added as the last axis."""

    log_frequency: Real
    shapes: Real
    turned: Real


@dataclass(frozen=True)
class Groups:
    """Groups of c of the model's modes each, seen in the basis of the measured shapes.

    Attributes
    ----------
    read : ndarray, (g, s, c)
        What the sensors read of the model's modes, mass-normalised.
    measured, weight : ndarray, (g, c, s)
        Measured shapes, and one over the variance of each entry; 0 where not measured.
    frequency_hz, measured_hz : ndarray, (g, c)
    uncertain : ndarray, (g, c)
        1 σ of ln f, measured and model.
    """

    read: Real
    measured: Real
    weight: Real
    frequency_hz: Real
    measured_hz: Real
    uncertain: Real

    def only(self, keep: NDArray[np.bool_]) -> Groups:
        """Some of them, by a mask (g,)."""
        return Groups(*(getattr(self, f.name)[keep] for f in fields(self)))

    @cached_property
    def told_apart(self) -> NDArray[np.bool_]:
        """True where the sensors tell the modes of a group apart, the model's and the measured ones, (g,)."""
        size = np.sqrt(np.maximum(np.einsum("gkaa->gka", self._gram), 1e-300))
        alike = self._gram / size[..., :, None] / size[..., None, :]
        pair = alike.shape[-1] == 2
        least = 1 - np.abs(alike[..., 0, 1]) if pair else np.linalg.eigvalsh(alike)[..., 0]
        independent = np.min(least, axis=1) > _INDEPENDENT
        found = np.zeros(len(independent), bool)
        if np.any(independent):
            some = self if np.all(independent) else self.only(independent)
            found[independent] = (some._polar[1][:, -1] ** 2 > _INDEPENDENT) & np.all(
                some._length > 0, axis=1
            )
        return found

    @cached_property
    def _weighed(self) -> Real:
        """What the sensors read, weighed by those of every measured mode, (g, k, c, s)."""
        return np.asarray(self.read.transpose(0, 2, 1)[:, None] * self.weight[:, :, None, :])

    @cached_property
    def _gram(self) -> Real:
        return np.asarray(self._weighed @ self.read[:, None])

    @cached_property
    def _inverse(self) -> Real:
        return np.asarray(np.linalg.inv(self._gram), float)

    @cached_property
    def _share(self) -> Real:
        """How much of every model mode a measured one holds, (g, k, c)."""
        return np.asarray((self._inverse @ (self._weighed @ self.measured[..., None]))[..., 0])

    @cached_property
    def _length(self) -> Real:
        return np.asarray(np.linalg.norm(self._share, axis=2), float)

    @cached_property
    def _unit(self) -> Real:
        return np.asarray(self._share / np.maximum(self._length, 1e-300)[..., None])

    @cached_property
    def _polar(self) -> tuple[Real, Real, Real]:
        left, spread, right = np.linalg.svd(self._unit.transpose(0, 2, 1))
        return left, spread, right

    @cached_property
    def basis(self) -> Real:
        """The orthonormal basis nearest to the measured shapes: (g, model mode, measured mode)."""
        return np.asarray(self._polar[0] @ self._polar[2])

    @cached_property
    def _matrix(self) -> Real:
        square = (2 * np.pi * self.frequency_hz) ** 2
        return np.asarray(self.basis.transpose(0, 2, 1) @ (square[..., None] * self.basis))

    @cached_property
    def _inverse_distance(self) -> Real:
        """By how much of the other one a measured mode is turned per entry of the matrix between them: one over the
        distance of their eigenvalues, less where that is uncertain; (g, other one, mode).
        """
        square, uncertain = (2 * np.pi * self.measured_hz) ** 2, self.uncertain
        apart = square[:, None, :] - square[:, :, None]
        blurred = (square[:, None, :] + square[:, :, None]) * np.hypot(
            uncertain[:, None, :], uncertain[:, :, None]
        )
        return np.asarray(apart / np.maximum(apart**2 + blurred**2, 1e-300))

    @cached_property
    def _turn(self) -> Real:
        return np.asarray(self._matrix * self._inverse_distance)

    @cached_property
    def log_frequency(self) -> Real:
        """ln of frequencies in Hz, of the diagonal, (g, c)."""
        return np.asarray(0.5 * np.log(np.einsum("gaa->ga", self._matrix)) - np.log(2 * np.pi))

    @cached_property
    def shapes(self) -> Real:
        """What the sensors read of the combination nearest to every measured shape, (g, c, s)."""
        return np.asarray((self.read @ self.basis).transpose(0, 2, 1))

    @cached_property
    def turned(self) -> Real:
        """What a rotation adds to it, (g, c, s)."""
        return np.asarray((self.read @ (self.basis @ self._turn)).transpose(0, 2, 1))

    def slopes(self, by: Slopes) -> Turned:
        """Derivatives by all unknowns."""
        turning = self._turning(by)
        basis_slope = _times(self.basis, turning)
        back = self.basis.transpose(0, 2, 1)
        changed = _times(back, _by(by.reduced, self.basis))
        changed += _times(self._matrix, turning) - _by(turning, self._matrix)
        own = np.einsum("gaa->ga", self._matrix)
        turn_slope = changed * self._inverse_distance[..., None]
        rotated_slope = _by(basis_slope, self._turn) + _times(self.basis, turn_slope)

        def of_shapes(combination: Real, change: Real) -> Real:
            moved = _times(combination.transpose(0, 2, 1), by.read)
            moved += (
                (self.read @ change.reshape(*change.shape[:2], -1))
                .reshape(*self.read.shape[:2], *change.shape[2:])
                .transpose(0, 2, 1, 3)
            )
            return np.asarray(moved)

        return Turned(
            0.5 * np.einsum("gaan->gan", changed) / own[..., None],
            of_shapes(self.basis, basis_slope),
            of_shapes(self.basis @ self._turn, rotated_slope),
        )

    def _turning(self, by: Slopes) -> Real:
        """Rotation of the basis, which is the polar factor of the normalised shares, (g, c, c, n)."""
        rest = self.weight * (self.measured - self._share @ self.read.transpose(0, 2, 1))
        pulled = (rest[:, None] @ by.read).transpose(0, 2, 1, 3)
        pulled = pulled + self._weighed @ (by.measured - _times(self._share, by.read))
        share_slope = self._inverse @ pulled
        unit_slope = share_slope - self._unit[..., None] * (self._unit[..., None, :] @ share_slope)
        unit_slope /= self._length[..., None, None]
        along = (self.basis.transpose(0, 2, 1)[:, None] @ unit_slope).transpose(0, 2, 1, 3)
        skew = along - along.transpose(0, 2, 1, 3)
        _, spread, right = self._polar
        back = right.transpose(0, 2, 1)
        inner = _by(_times(right, skew), back) / (spread[:, :, None] + spread[:, None, :])[..., None]
        return _by(_times(back, inner), right)


def _times(matrix: Real, slope: Real) -> Real:
    """Σ_b matrix_ab slope_b…, (g, a, …)."""
    flat = matrix @ slope.reshape(*slope.shape[:2], -1)
    return np.asarray(flat.reshape(*matrix.shape[:2], *slope.shape[2:]))


def _by(slope: Real, matrix: Real) -> Real:
    """Σ_b slope_ab… matrix_bc, (g, a, c, …)."""
    return np.asarray(matrix.transpose(0, 2, 1)[:, None] @ slope)
