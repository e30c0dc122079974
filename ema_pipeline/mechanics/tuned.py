"""How large a change of a system is that gives one of its modes a measured frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_REAL = 1e-6
"""Imaginary part of a size, over its magnitude, up to which it is real: the matrices are no longer definite."""
_ROUNDING = 1e-10
"""Share of the largest reciprocal size below which one is that of an infinite size."""


def tuned_sizes(
    mass: NDArray[np.float64],
    stiffness: NDArray[np.float64],
    mass_change: NDArray[np.float64],
    stiffness_change: NDArray[np.float64],
    frequency_hz: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """All sizes s of a change at which an undamped mode has a given frequency, and the shapes of these modes.

    (K + s·ΔK) v = ω² (M + s·ΔM) v is a linear eigenvalue problem for s: as many sizes as the change has rank.

    Parameters
    ----------
    mass, stiffness : ndarray, (n, n)
    mass_change, stiffness_change : ndarray, (n, n)
        By one unit of the size.
    frequency_hz : float
        Of no mode of the unchanged system.

    Returns
    -------
    sizes : ndarray, (k,)
    shapes : ndarray, (n, k)
        Columns.
    """
    squared = (2 * np.pi * frequency_hz) ** 2
    there = stiffness - squared * mass
    by_size = stiffness_change - squared * mass_change
    try:
        reciprocal, shapes = np.linalg.eig(np.linalg.solve(there, -by_size))
    except np.linalg.LinAlgError:  # the frequency is one of the unchanged system
        return np.zeros(0), np.zeros((len(mass), 0))
    size = np.abs(reciprocal)
    on = (size > _ROUNDING * np.max(size, initial=0.0)) & (np.abs(reciprocal.imag) <= _REAL * size)
    return 1 / reciprocal[on].real, shapes[:, on].real
