"""FRFs of a linear system as sums over its poles: a few numbers from which any FRF is computed at any line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem

_RIGID_HZ = 1e-3
"""Rigid-body modes are moved to about this frequency: a double pole at 0 Hz has no partial fractions."""


@dataclass(frozen=True)
class PartialFractions:
    """Receptance Σ out·in/(jω - s) over all poles s, for ω > 0.

    Attributes
    ----------
    poles : complex ndarray, (n_poles,)
        rad/s; those of either sign of the frequency.
    outputs, inputs : complex ndarray, (n_outputs, n_poles), (n_inputs, n_poles)
    """

    poles: NDArray[np.complex128]
    outputs: NDArray[np.complex128]
    inputs: NDArray[np.complex128]

    def receptance(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Displacement over force, m/N, (n_outputs, n_inputs, n_lines)."""
        terms = 1 / (2j * np.pi * frequency_hz - self.poles[:, None])
        return np.asarray(np.einsum("or,ir,rl->oil", self.outputs, self.inputs, terms, optimize=True))


def partial_fractions(
    system: LinearSystem, out_rows: NDArray[np.float64], in_rows: NDArray[np.float64]
) -> PartialFractions:
    """Poles and residues of a system with any damping.

    Parameters
    ----------
    system : LinearSystem
    out_rows, in_rows : ndarray, (n_outputs, n), (n_inputs, n)
        Rows of sensors and hammer, see `mechanics.system.sensor_row`.
    """
    n = len(system.dofs)
    stiffness = system.stiffness + (2 * np.pi * _RIGID_HZ) ** 2 * system.mass + 1j * system.structural
    damping = total_damping(system)
    root = scipy.linalg.cholesky(system.mass, lower=True)

    def scaled(matrix: NDArray[np.complex128] | NDArray[np.float64]) -> NDArray[np.complex128]:
        half = scipy.linalg.solve_triangular(root, matrix, lower=True)
        return np.asarray(scipy.linalg.solve_triangular(root, half.T, lower=True).T)

    state = np.zeros((2 * n, 2 * n), dtype=complex)
    state[:n, n:] = np.eye(n)
    state[n:, :n] = -scaled(stiffness)
    state[n:, n:] = -scaled(damping)
    poles, right = scipy.linalg.eig(state)
    left = np.linalg.inv(right)
    to_motion = scipy.linalg.solve_triangular(root.T, right[:n], lower=False)
    from_force = scipy.linalg.solve_triangular(root.T, left[:, n:].T, lower=False)
    return PartialFractions(
        poles, np.asarray(out_rows @ to_motion, complex), np.asarray(in_rows @ from_force, complex)
    )
