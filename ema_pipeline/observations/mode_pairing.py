"""Which mode of the model is which measured one: by frequency and shape, all modes of a configuration at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.observations.comparison_kernel import likeness
from ema_pipeline.observations.mode_data import ModeData

_FREQUENCY_REACH = 0.1
"""Difference of ln f that costs a pair as much as shapes that have nothing in common; wider while a fit is annealed."""
_FREQUENCY_REACH_ALONE = 0.3
_LEAVE = 0.3
"""Cost above the best at which an assignment leaves a measured mode without a partner."""
_LEAVE_DOUBLE = -0.5
"""The same of a `double` one: its shape must speak for a partner, and not only the lack of a nearer one."""


def paired(
    data: ModeData,
    frequency_hz: NDArray[np.float64],
    read: NDArray[np.float64] | NDArray[np.complex128],
    heat: float = 1.0,
) -> NDArray[np.int64]:
    """Index of the model mode of every measured one, -1 for none, (m,).

    Parameters
    ----------
    data : ModeData
    frequency_hz : ndarray, (n,)
        Of the model's modes.
    read : ndarray, (s, n)
        What the sensors read of their shapes.
    heat : float
        Factor on all uncertainties while a fit is annealed.
    """
    log = np.log(np.maximum(frequency_hz, 1e-6))
    apart = np.abs(log[None] - data.log_frequency[:, None])
    if data.shapes.shape[1]:
        alike = likeness(data.known_shapes, data.squares, data.seen, turned(read))
        if np.any(whirl := data.whirling):
            cross = np.abs(np.conj(data.complex_shapes[whirl]) @ read) ** 2
            norm = data.squares[whirl, None] * (data.seen[whirl] @ np.abs(read) ** 2)
            alike[whirl] = cross / np.maximum(norm, 1e-300)
        reach = _FREQUENCY_REACH * (1 + 0.1 * (heat - 1))
        cost = np.minimum(apart / reach, 3.0) - alike
    else:
        # convex, so that close modes keep their order: two crossed pairs would cost as much as two straight ones
        cost = np.minimum(apart * (1 + apart) / _FREQUENCY_REACH_ALONE, 3.0) - 1.0
    m, n = cost.shape
    padded = np.empty((m, n + m))
    padded[:, :n], padded[:, n:] = cost, np.where(data.double, _LEAVE_DOUBLE, _LEAVE)[:, None]
    column = scipy.optimize.linear_sum_assignment(padded)[1]
    return np.where(column < n, column, -1)


def turned(read: NDArray[np.float64] | NDArray[np.complex128]) -> NDArray[np.float64]:
    """Complex shapes, (s, k), turned as measured ones are, and made real; real ones as they are."""
    if not np.iscomplexobj(read):
        return np.asarray(read, float)
    return np.asarray(np.real(read * np.exp(-0.5j * np.angle(np.sum(read**2, axis=0)))), float)


def _with_rest(to: NDArray[np.int64], data: ModeData, frequency_hz: NDArray[np.float64]) -> NDArray[np.int64]:
    """Pairs, and what is left of measured and undamped modes by frequency alone.

    Damping turns undamped modes of nearly one frequency into each other, so that some resemble none that was measured.
    """
    alone = np.flatnonzero(to < 0)
    if not len(alone):
        return to
    free = np.setdiff1d(np.arange(len(frequency_hz)), to)
    log = np.log(np.maximum(frequency_hz[free], 1e-6))
    apart = np.abs(log[None] - data.log_frequency[alone, None])
    which, rest = scipy.optimize.linear_sum_assignment(apart)
    near = apart[which, rest] < _FREQUENCY_REACH
    found = to.copy()
    found[alone[which[near]]] = free[rest[near]]
    return found


@dataclass(frozen=True)
class OwnDamping:
    """Undamped modes of a configuration whose damping ratios are unknowns of their own.

    They are known by the measured modes that they resemble: numbers of modes change where frequencies cross.

    Attributes
    ----------
    data : ModeData
    along : ndarray, (s, n)
        Rows of the motion along the sensors.
    """

    data: ModeData
    along: NDArray[np.float64]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns, one for every measured mode."""
        return tuple(
            f"damping of measured mode {r + 1} of {self.data.configuration}" for r in range(len(self.data))
        )

    def slopes(self, eigenvalues: NDArray[np.float64], shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 for the undamped mode that each unknown is of, 0 elsewhere, (m, n).

        Parameters
        ----------
        eigenvalues : ndarray, (n,)
        shapes : ndarray, (n_dofs, n)
        """
        read = self.along @ shapes[: self.along.shape[1]]
        hz = np.sqrt(eigenvalues) / (2 * np.pi)
        to = _with_rest(paired(self.data, hz, read), self.data, hz)
        found = np.zeros((len(to), shapes.shape[1]))
        on = np.flatnonzero(to >= 0)
        found[on, to[on]] = 1.0
        return found
