"""Which mode of the model is which measured one: by frequency and shape, all modes of a configuration at once."""

from __future__ import annotations

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
