"""Accelerance of a system with any damping as a sum over its poles: exact, and fast at many lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.modes import eigen_solution, total_damping
from ema_pipeline.mechanics.system import LinearSystem

WORST_CONDITION = 1e8
"""Eigenvectors nearer to dependent than this would cost half the digits: the lines are then solved one by one."""

UNCOUPLED = 1e-12
"""A rigid-body mode with less damping than this, over the largest in the system, has none."""


def pole_accelerance(
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Acceleration over force; parameters and result are those of `mechanics.frf.accelerance`.

    In modal coordinates q̈ + Γq̇ + (Λ + jH)q = Φᵀf. Undamped rigid-body modes, whose double pole at zero has but
    one eigenvector, answer with their constant; the rest is Σ_k a_k·b_k/(jω - s_k) over the eigenvalues of the
    state matrix.
    """
    values, phi = eigen_solution(system)
    viscous = phi.T @ total_damping(system) @ phi
    structural = phi.T @ system.structural @ phi
    rigid = _undamped_rigid(values, viscous, structural)
    out, into = out_rows @ phi, in_rows @ phi
    elastic = np.flatnonzero(~rigid)
    block = np.ix_(elastic, elastic)
    n = len(elastic)
    state = np.zeros((2 * n, 2 * n), dtype=complex)
    state[:n, n:] = np.eye(n)
    state[n:, :n] = -np.diag(values[elastic]) - 1j * structural[block]
    state[n:, n:] = -viscous[block]
    scale = np.sqrt(np.max(values, initial=1e-300))
    state[:n, n:] *= scale
    state[n:, :n] /= scale
    poles, vectors = np.linalg.eig(state)
    if n and np.linalg.cond(vectors) > WORST_CONDITION:
        return accelerance(system, frequency_hz, out_rows, in_rows)
    push = np.zeros((2 * n, len(in_rows)), dtype=complex)
    push[n:] = into[:, elastic].T / scale
    given = np.linalg.solve(vectors, push)
    seen = out[:, elastic] @ vectors[:n]
    positive = frequency_hz[frequency_hz > 0]
    lowest = float(positive.min()) if positive.size else 1.0
    jw = 2j * np.pi * np.where(frequency_hz > 0, frequency_hz, 1e-4 * lowest)
    kernel = jw**2 / (jw - poles[:, None])
    result = np.empty((len(out), len(into), len(frequency_hz)), dtype=complex)
    for i, rigid_share in enumerate(into[:, rigid]):
        result[:, i] = (seen * given[:, i]) @ kernel
        result[:, i] += (out[:, rigid] @ rigid_share)[:, None]
    return result


def _undamped_rigid(
    values: NDArray[np.float64], viscous: NDArray[np.float64], structural: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Rigid-body modes that no damping couples to anything, (n_modes,)."""
    free = values == 0.0
    for matrix in (viscous, structural):
        free &= np.max(np.abs(matrix), axis=1) <= UNCOUPLED * max(float(np.max(np.abs(matrix))), 1e-300)
    return free
