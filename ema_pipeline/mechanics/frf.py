"""Frequency response functions of a linear system, exact at every line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.modes import eigen_solution, total_damping
from ema_pipeline.mechanics.system import LinearSystem

_BLOCK = 512


def receptance(
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Displacement over force, m/N.

    Parameters
    ----------
    system : LinearSystem
    frequency_hz : ndarray, (n_lines,)
    out_rows, in_rows : ndarray, (n_outputs, n), (n_inputs, n)
        Rows of sensors and hammer, see `mechanics.system.sensor_row`.

    Returns
    -------
    complex ndarray, (n_outputs, n_inputs, n_lines)

    Raises
    ------
    EmaError
        If a line falls on a pole of the system (0 Hz with a rigid-body mode).
    """
    frequency_hz = np.asarray(frequency_hz, dtype=float)
    if not np.any(system.damping) and not np.any(system.structural):
        return _modal_receptance(system, frequency_hz, out_rows, in_rows)
    return _direct_receptance(system, frequency_hz, out_rows, in_rows)


def accelerance(
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Acceleration over force, (m/s²)/N, (n_outputs, n_inputs, n_lines); see `receptance`.

    Finite at 0 Hz also with rigid-body modes: the limit from above is given there.
    """
    frequency_hz = np.asarray(frequency_hz, dtype=float)
    positive = frequency_hz[frequency_hz > 0]
    smallest = float(positive.min()) if positive.size else 1.0
    shifted = np.where(frequency_hz > 0, frequency_hz, 1e-4 * smallest)
    factor = -((2 * np.pi * shifted) ** 2)
    return np.asarray(factor * receptance(system, shifted, out_rows, in_rows))


def _modal_receptance(
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Sum over normal modes, exact where only the modal damping ratio acts."""
    values, phi = eigen_solution(system)
    omega = 2 * np.pi * frequency_hz
    denominator = (
        values[:, None] - omega**2 + 2j * system.modal_damping_ratio * np.sqrt(values)[:, None] * omega
    )
    if np.any(denominator == 0):
        raise _infinite(frequency_hz[np.any(denominator == 0, axis=0)][0])
    return np.einsum("or,ir,rl->oil", out_rows @ phi, in_rows @ phi, 1 / denominator, optimize=True)


def _direct_receptance(
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Inverse of the dynamic stiffness, line by line."""
    damping = total_damping(system)
    result = np.empty((len(out_rows), len(in_rows), len(frequency_hz)), dtype=complex)
    for start in range(0, len(frequency_hz), _BLOCK):
        omega = 2 * np.pi * frequency_hz[start : start + _BLOCK, None, None]
        stiffness = system.stiffness - omega**2 * system.mass + 1j * (omega * damping + system.structural)
        try:
            motion = np.linalg.solve(stiffness, np.broadcast_to(in_rows.T, (len(omega), *in_rows.T.shape)))
        except np.linalg.LinAlgError:
            raise _infinite(float(omega.min() / (2 * np.pi))) from None
        result[:, :, start : start + _BLOCK] = np.moveaxis(out_rows @ motion, 0, -1)
    return result


def _infinite(frequency_hz: float) -> EmaError:
    return EmaError(
        f"the receptance is infinite at {frequency_hz:g} Hz, a pole of the model; "
        "leave this line out or take the accelerance"
    )
