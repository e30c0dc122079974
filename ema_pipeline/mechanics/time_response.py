"""Response of a linear system to a sampled force, exact for a force that runs straight between samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem


@dataclass(frozen=True)
class TimeResponse:
    """Motion at the outputs, each (n_outputs, n_samples): m, m/s, m/s²."""

    displacement: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]


def time_response(
    system: LinearSystem,
    sample_rate_hz: float,
    forces: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> TimeResponse:
    """Response from rest.

    Parameters
    ----------
    system : LinearSystem
        With any viscous, gyroscopic and modal damping; structural damping has no exact time response.
    sample_rate_hz : float
    forces : ndarray, (n_inputs, n_samples)
        N; taken to run straight from sample to sample.
    out_rows, in_rows : ndarray, (n_outputs, n), (n_inputs, n)

    Returns
    -------
    TimeResponse

    Raises
    ------
    EmaError
        For a system with structural damping.

    Notes
    -----
    Ramp-invariant recursion x₊ = Φx + Γ₀f + Γ₁f₊ in state space; Φ and Γ come from one matrix exponential
    (C. F. Van Loan, *IEEE Trans. Autom. Control* 23 (1978) 395-404), so there is no step-size error.
    """
    if np.any(system.structural):
        raise EmaError(
            "a loss factor holds at steady state only and has no time response; use the frequency domain"
        )
    n = len(system.dofs)
    a, b = state_space(system, in_rows)
    transition, step, ramp = recursion(a, b, sample_rate_hz)

    forces = np.atleast_2d(np.asarray(forces, dtype=float))
    states = np.zeros((forces.shape[1], 2 * n))
    states[1:] = (step @ forces[:, :-1] + ramp @ forces[:, 1:]).T
    for k in range(1, len(states)):
        states[k] += transition @ states[k - 1]
    rates = states @ a.T + forces.T @ b.T
    return TimeResponse(
        displacement=out_rows @ states[:, :n].T,
        velocity=out_rows @ states[:, n:].T,
        acceleration=out_rows @ rates[:, n:].T,
    )


def recursion(
    a: NDArray[np.float64], b: NDArray[np.float64], sample_rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Φ (s, s), Γ₀ and Γ₁ (s, n_inputs) of the ramp-invariant recursion of ẋ = a·x + b·f."""
    size, inputs = b.shape
    block = np.zeros((size + 2 * inputs, size + 2 * inputs))
    block[:size, :size] = a / sample_rate_hz
    block[:size, size : size + inputs] = b / sample_rate_hz
    block[size : size + inputs, size + inputs :] = np.eye(inputs)
    exponential = scipy.linalg.expm(block)[:size]
    ramp = exponential[:, size + inputs :]
    return exponential[:, :size], exponential[:, size : size + inputs] - ramp, ramp


def state_space(
    system: LinearSystem, in_rows: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A (2n, 2n) and B (2n, n_inputs) of the state (x, ẋ)."""
    n = len(system.dofs)
    factor = scipy.linalg.cho_factor(system.mass)
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:, :n] = -scipy.linalg.cho_solve(factor, system.stiffness)
    a[n:, n:] = -scipy.linalg.cho_solve(factor, total_damping(system))
    b = np.zeros((2 * n, len(in_rows)))
    b[n:] = scipy.linalg.cho_solve(factor, in_rows.T)
    return a, b
