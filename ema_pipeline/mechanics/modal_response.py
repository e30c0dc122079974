"""Response from rest of an assembly whose nonlinear elements have no memory, to one force.

The linear part, tangents of the nonlinear elements included, is advanced exactly in its own complex modes, where
every state is a number of its own; the nonlinear elements only need their stretches. A compiled loop takes this
through time. Elements with a memory take the slower way of `mechanics.marching.marched_response`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import check_element
from ema_pipeline.mechanics.marching import element_rows, interpolated
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.time_response import TimeResponse

_SLOWEST_HZ = 1e-3
"""Rigid-body modes are held by springs so soft that a record of seconds does not see them."""


def response_from_rest(
    assembly: Assembly,
    sample_rate_hz: float,
    force: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_row: NDArray[np.float64],
    substeps: int,
) -> TimeResponse:
    """Response of one assembly, whose elements have no memory, to one force.

    Parameters
    ----------
    assembly : Assembly
        All nonlinear elements with a `Nonlinear.law`.
    sample_rate_hz : float
    force : ndarray, (1, n_samples)
        N; taken to run straight from sample to sample.
    out_rows, in_row : ndarray, (n_outputs, n), (1, n)
    substeps : int
        Steps per sample.

    Raises
    ------
    EmaError
        For structural damping, and where the motion grows without bound.
    """
    from ema_pipeline.mechanics.modal_response_kernel import march  # compiles at its first use

    elements = assembly.nonlinear
    for element in elements:
        check_element(element)
    modes = _modal(assembly.system())
    rows = element_rows(assembly, elements)
    into = np.vstack([in_row, -rows])
    # displacements, velocities and accelerations at once
    orders, read = np.repeat(np.arange(3), len(out_rows)), np.tile(out_rows, (3, 1))
    direct = np.where(orders[:, None] == 2, read @ modes.flexibility @ into.T, 0.0)
    stretch = rows @ modes.right
    step = 1 / (sample_rate_hz * substeps)
    found = march(
        np.array([e.law for e in elements], dtype=float).reshape(len(elements), 4),
        modes.poles,
        (modes.left @ into.T).T,
        np.concatenate([stretch, stretch * modes.poles]),
        (read @ modes.right) * modes.poles ** orders[:, None],
        direct[:, 1:],
        interpolated(force, substeps),
        step,
        substeps,
    )
    if found.failed:
        raise EmaError(
            f"no solution with {', '.join(e.name for e in elements)}: the motion grows without bound, or the step of "
            f"{step:.3g} s is too long; check the elements' values, or raise the sample rate"
        )
    motion = found.motion[0].T + direct[:, :1] * force
    return TimeResponse(*motion.reshape(3, len(out_rows), -1))


@dataclass(frozen=True)
class _Modal:
    """ż = poles·z + left·f, x = Re(right·z); `flexibility` is the inverse of the mass matrix."""

    poles: NDArray[np.complex128]
    left: NDArray[np.complex128]
    right: NDArray[np.complex128]
    flexibility: NDArray[np.float64]


def _modal(system: LinearSystem) -> _Modal:
    """Complex modes of the damped system; of each conjugate pair the one with Im > 0, counted twice."""
    if np.any(system.structural):
        raise EmaError(
            "a loss factor holds at steady state only and has no time response; use the frequency domain"
        )
    values, phi = eigen_solution(system)
    omega = np.maximum(np.sqrt(values), 2 * np.pi * _SLOWEST_HZ)
    own = 2 * system.modal_damping_ratio * omega
    viscous = phi.T @ system.damping @ phi
    flexibility = phi @ phi.T
    coupled = np.max(np.abs(viscous - np.diag(np.diag(viscous))), initial=0.0) > 1e-9 * omega[-1]
    total = own + np.diag(viscous)
    if not coupled and np.all(total < 2 * omega):
        decay = 0.5 * total
        damped = np.sqrt(omega**2 - decay**2)
        return _Modal(
            (-decay + 1j * damped).astype(complex),
            phi.T.astype(complex),
            (phi / (1j * damped)).astype(complex),
            flexibility,
        )
    n = len(omega)
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:, :n] = -np.diag(omega**2)
    a[n:, n:] = -(viscous + np.diag(own))
    poles, vectors = np.linalg.eig(a)
    left = np.asarray(np.linalg.inv(vectors)[:, n:] @ phi.T, dtype=complex)
    right = np.asarray(phi @ vectors[:n], dtype=complex)
    keep = poles.imag >= 0
    twice = np.where(poles.imag > 0, 2.0, 1.0)
    return _Modal(poles[keep].astype(complex), left[keep], (right * twice)[:, keep], flexibility)
