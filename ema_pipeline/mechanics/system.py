"""A linear mechanical system: named DOFs and their matrices. Knows no rig."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LinearSystem:
    """M ẍ + (C + G) ẋ + (K + jD) x = f.

    Attributes
    ----------
    dofs : tuple of str
        Names of the generalised coordinates, e.g. ``"sun.x"``.
    mass, stiffness : ndarray, (n, n)
        Symmetric; kg (or I/r²), N/m.
    damping : ndarray, (n, n)
        Viscous damping, plus a skew-symmetric part for gyroscopic coupling, N·s/m.
    structural : ndarray, (n, n)
        Imaginary part of the stiffness (loss factor times stiffness), N/m.
    modal_damping_ratio : float
        Damping ratio that every mode has on top of `damping` and `structural`.
    sensors : dict of str to ndarray (n,)
        Row vectors that turn the coordinates into what a sensor at a DOF reads, for DOFs that are no
        coordinates of their own (e.g. ``"planet2.x"``).
    """

    dofs: tuple[str, ...]
    mass: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    structural: NDArray[np.float64]
    modal_damping_ratio: float = 0.0
    sensors: dict[str, NDArray[np.float64]] = field(default_factory=dict)
