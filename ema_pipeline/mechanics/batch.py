"""Responses of many assemblies to many hammer blows at once, nonlinear elements included.

The linear part, tangents of the nonlinear elements included, is advanced exactly in its own complex modes, where
every state is a number of its own; the nonlinear elements only need their stretches. A compiled loop takes all
pairs of assembly and blow through time. Elements with a memory take the slower way of
`mechanics.marching.marched_response`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import check_element
from ema_pipeline.mechanics.marching import element_rows, interpolated, marched_response
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.mechanics.sampling import band_limited
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.mechanics.time_response import TimeResponse

if TYPE_CHECKING:
    from ema_pipeline.mechanics.kernel import Marched

ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Number of derivatives of each quantity that a sensor may measure."""

_NO_FORCE = (0.0, 0.0, 0.0, 0.0)
_SLOWEST_HZ = 1e-3
"""Rigid-body modes are held by springs so soft that a record of seconds does not see them."""


@dataclass(frozen=True)
class Blows:
    """Hammer blows of one configuration, as sampled.

    Attributes
    ----------
    sample_rate_hz : float
    force : ndarray, (n_blows, n_samples)
        N, from rest on.
    in_rows : ndarray, (n_blows, n)
        Where each blow strikes, over the coordinates.
    out_rows : ndarray, (n_outputs, n)
        Where the sensors sit.
    quantities : tuple of str
        What each sensor measures, see `ORDERS`.
    """

    sample_rate_hz: float
    force: NDArray[np.float64]
    in_rows: NDArray[np.float64]
    out_rows: NDArray[np.float64]
    quantities: tuple[str, ...]


def batch_response(assemblies: Sequence[Assembly], blows: Blows, substeps: int) -> NDArray[np.float64]:
    """What the sensors read behind an anti-alias filter, (n_assemblies, n_blows, n_outputs, n_samples).

    Parameters
    ----------
    assemblies : sequence of Assembly
        With the same coordinates; nonlinear elements of one name act along one row.
    blows : Blows
        Between samples the force is band-limited, as an analyser with an anti-alias filter records it.
    substeps : int
        Steps per sample; the error of the nonlinear forces falls with the square of the step.

    Raises
    ------
    EmaError
        For structural damping, and where the motion grows without bound.
    """
    if any(e.law is None for a in assemblies for e in a.nonlinear):
        return _one_by_one(assemblies, blows, substeps)
    force, straight = fine_force(blows.force, substeps)
    orders = np.array([ORDERS[q] for q in blows.quantities])
    batch = _prepared(assemblies, blows.out_rows, orders, blows.in_rows)
    step = 1 / (blows.sample_rate_hz * substeps)
    found = _moved(batch, straight, step, substeps, trace=True)
    result = found.motion.swapaxes(2, 3)
    result += batch.direct[:, :, : len(force)].swapaxes(1, 2)[..., None] * force[None, :, None, ::substeps]
    lost = band_limited(found.forces, substeps) - found.forces
    for a in range(len(assemblies)):
        result[a] += _driven(batch, a, lost[a], step, substeps)
    return result


def _driven(
    batch: _Batch, a: int, forces: NDArray[np.float64], step: float, substeps: int
) -> NDArray[np.float64]:
    """Motion (n_blows, n_outputs, n_samples) of one assembly's linear part under the elements' forces given."""
    hits, m, steps = forces.shape
    if not forces.any():
        return np.zeros((hits, len(batch.outputs[a]), (steps - 1) // substeps + 1))
    at = np.tile(np.arange(batch.inputs.shape[1] - m, batch.inputs.shape[1]), hits)
    linear = replace(
        batch,
        laws=batch.laws[a : a + 1, :0],
        poles=batch.poles[a : a + 1],
        inputs=batch.inputs[a : a + 1, at],
        stretch=batch.stretch[a : a + 1, :0],
        outputs=batch.outputs[a : a + 1],
        direct=batch.direct[a : a + 1, :, at],
    )
    flat = forces.reshape(-1, steps)
    found = _marched(linear, flat, step, substeps).motion[0].swapaxes(1, 2)
    found += linear.direct[0].T[..., None] * flat[:, None, ::substeps]
    return np.asarray(found.reshape(hits, m, *found.shape[1:]).sum(axis=1))


def compiled_response(
    assemblies: Sequence[Assembly],
    sample_rate_hz: float,
    force: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    orders: NDArray[np.int64],
    in_rows: NDArray[np.float64],
    substeps: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Motion from rest under forces that run straight from step to step.

    Parameters
    ----------
    assemblies : sequence of Assembly
        All elements with a `Nonlinear.law`.
    sample_rate_hz : float
        Of the result.
    force : ndarray, (n_blows, n_steps)
        N, at `substeps` steps per sample.
    out_rows, in_rows : ndarray, (n_outputs, n), (n_blows, n)
    orders : ndarray of int, (n_outputs,)
        Derivatives of each output: 0 for displacement, 2 for acceleration.
    substeps : int

    Returns
    -------
    motion : ndarray, (n_assemblies, n_blows, n_outputs, n_samples)
        Without what a force gives an accelerometer at once.
    direct : ndarray, (n_assemblies, n_blows, n_outputs)
        That part, per newton.

    Raises
    ------
    EmaError
        For structural damping, and where the motion grows without bound.
    """
    batch = _prepared(assemblies, out_rows, orders, in_rows)
    step = 1 / (sample_rate_hz * substeps)
    found = _moved(batch, force, step, substeps)
    return found.motion.swapaxes(2, 3), batch.direct[:, :, : len(force)].swapaxes(1, 2)


def response_from_rest(
    assembly: Assembly,
    sample_rate_hz: float,
    forces: NDArray[np.float64],
    out_rows: NDArray[np.float64],
    in_rows: NDArray[np.float64],
    substeps: int,
) -> TimeResponse:
    """Response of one assembly, whose elements have no memory, to one force, (1, n_samples), from rest."""
    orders = np.repeat(np.arange(3), len(out_rows))
    motion, direct = compiled_response(
        [assembly], sample_rate_hz, interpolated(forces, substeps), np.tile(out_rows, (3, 1)), orders, in_rows,
        substeps,
    )  # fmt: skip
    both = motion[0, 0] + direct[0, 0][:, None] * forces
    return TimeResponse(*both.reshape(3, len(out_rows), -1))


@dataclass(frozen=True)
class _Batch:
    """Modes of many assemblies, filled up with nothing to one size.

    Attributes
    ----------
    names : tuple of str
        Of all elements.
    laws : ndarray, (A, m, 4)
    poles : complex ndarray, (A, P)
    inputs : complex ndarray, (A, n_blows + m, P)
    stretch : complex ndarray, (A, 2m, P)
    outputs : complex ndarray, (A, n_outputs, P)
    direct : ndarray, (A, n_outputs, n_blows + m)
        What a force gives an accelerometer at once.
    """

    names: tuple[str, ...]
    laws: NDArray[np.float64]
    poles: NDArray[np.complex128]
    inputs: NDArray[np.complex128]
    stretch: NDArray[np.complex128]
    outputs: NDArray[np.complex128]
    direct: NDArray[np.float64]


def _prepared(
    assemblies: Sequence[Assembly],
    out_rows: NDArray[np.float64],
    orders: NDArray[np.int64],
    in_rows: NDArray[np.float64],
) -> _Batch:
    """Modes of assemblies with the same coordinates, and what blows and elements do to them."""
    elements = {e.name: e for a in assemblies for e in a.nonlinear}
    for assembly in assemblies:
        for element in assembly.nonlinear:
            check_element(element)
    modes = [_modal(a.system()) for a in assemblies]
    m, size = len(elements), max(len(p.poles) for p in modes)
    count, hits = len(assemblies), len(in_rows)
    rows = element_rows(assemblies[0], list(elements.values()))
    poles = np.zeros((count, size), dtype=complex)
    inputs = np.zeros((count, hits + m, size), dtype=complex)
    outputs = np.zeros((count, len(out_rows), size), dtype=complex)
    stretch = np.zeros((count, 2 * m, size), dtype=complex)
    direct = np.zeros((count, len(out_rows), hits + m))
    into = np.vstack([in_rows, -rows])
    laws = np.zeros((count, m, 4))
    for i, (assembly, p) in enumerate(zip(assemblies, modes, strict=True)):
        k = len(p.poles)
        poles[i, :k] = p.poles
        inputs[i, :, :k] = (p.left @ into.T).T
        outputs[i, :, :k] = (out_rows @ p.right) * p.poles ** orders[:, None]
        stretch[i, :m, :k] = rows @ p.right
        stretch[i, m:, :k] = (rows @ p.right) * p.poles
        direct[i] = np.where(orders[:, None] == 2, out_rows @ p.flexibility @ into.T, 0.0)
        own = {e.name: e.law for e in assembly.nonlinear}
        for j, name in enumerate(elements):
            laws[i, j] = own.get(name) or _NO_FORCE
    return _Batch(tuple(elements), laws, poles, inputs, stretch, outputs, direct)


def _marched(
    batch: _Batch, force: NDArray[np.float64], step: float, substeps: int, trace: bool = False
) -> Marched:
    """`mechanics.kernel.march` of a batch."""
    from ema_pipeline.mechanics.kernel import march  # compiles at its first use

    direct = batch.direct[:, :, len(force) :]
    return march(
        batch.laws,
        batch.poles,
        batch.inputs,
        batch.stretch,
        batch.outputs,
        direct,
        force,
        step,
        substeps,
        trace,
    )


def _moved(
    batch: _Batch, force: NDArray[np.float64], step: float, substeps: int, trace: bool = False
) -> Marched:
    """The same; EmaError where the motion of an assembly has no solution."""
    found = _marched(batch, force, step, substeps, trace)
    if found.failed.any():
        raise EmaError(
            f"no solution with {', '.join(batch.names)}: the motion grows without bound, or the step of {step:.3g} s "
            "is too long; check the elements' values, or give more substeps"
        )
    return found


def _one_by_one(assemblies: Sequence[Assembly], blows: Blows, substeps: int) -> NDArray[np.float64]:
    """The same for elements with a memory or a law of their own."""
    order = [ORDERS[q] for q in blows.quantities]
    result = []
    for assembly in assemblies:
        forgets = all(e.law is not None for e in assembly.nonlinear)
        respond = response_from_rest if forgets else marched_response
        for force, row in zip(blows.force, blows.in_rows, strict=True):
            r = respond(assembly, blows.sample_rate_hz, force[None], blows.out_rows, row[None], substeps)
            read = (r.displacement, r.velocity, r.acceleration)
            result.append([read[k][i] for i, k in enumerate(order)])
    return np.array(result).reshape(len(assemblies), len(blows.force), len(order), -1)


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


def fine_force(force: NDArray[np.float64], substeps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The force at the steps, and the values whose straight connections act on slow motions as it does.

    Straight lines between steps weaken what happens at frequency f by sinc²(f·step).
    """
    n = force.shape[1]
    length = scipy.fft.next_fast_len(n + 64, real=True)
    padded = np.pad(force, ((0, 0), (0, length - n)))
    spectrum = scipy.fft.rfft(padded, axis=1)
    ramp = np.sinc(np.arange(spectrum.shape[1]) / (length * substeps)) ** 2
    fine, straight = (
        scipy.fft.irfft(s * substeps, length * substeps, axis=1)[:, : (n - 1) * substeps + 1]
        for s in (spectrum, spectrum / ramp)
    )
    return fine, straight
