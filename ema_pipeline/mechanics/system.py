"""A linear mechanical system: named DOFs and their matrices. Knows no rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean


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


def sensor_row(system: LinearSystem, dof: Dof) -> NDArray[np.float64]:
    """Row vector that turns the system's coordinates into what a sensor at `dof` reads.

    Parameters
    ----------
    system : LinearSystem
    dof : Dof
        A coordinate (``sun.x``) or a derived place (``planet2.x``); its sign is applied.

    Returns
    -------
    ndarray, (n,)

    Raises
    ------
    EmaError
        If the system has no such DOF; the message proposes the nearest one.
    """
    if dof.point in system.dofs:
        row = np.zeros(len(system.dofs))
        row[system.dofs.index(dof.point)] = 1.0
    elif dof.point in system.sensors:
        row = np.array(system.sensors[dof.point], dtype=float)
    else:
        known = (*system.dofs, *system.sensors)
        raise EmaError(f"the model has no dof '{dof.point}'{did_you_mean(dof.point, known)}")
    return dof.sign * row


def sensor_rows(system: LinearSystem, dofs: Sequence[Dof]) -> NDArray[np.float64]:
    """Rows of several DOFs, (n_dofs, n); see `sensor_row`."""
    if not dofs:
        return np.zeros((0, len(system.dofs)))
    return np.stack([sensor_row(system, d) for d in dofs])
