"""Free-run simulation of an assembly under measured forces, with exact derivatives by any parameters.

The force between samples is what a band-limited signal has there. A straight line between samples would take a tenth of
the force away at a quarter of the sample rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from ema_pipeline.mechanics.driven_system import DrivenSystem, Slopes
from ema_pipeline.mechanics.system import LinearSystem

FINE, COARSE = 0.25, 0.65
"""Phase, in rad, by which the highest mode may turn in one step. A quarter leaves an error of a hundred thousandth of a
frequency; laws with kinks, such as hysteresis, need it too. While hypotheses are compared less will do."""
MOST_SUBSTEPS = 64
_PADDING = 400
"""Samples by which a record is continued at both ends before it is interpolated."""


def substeps_for(system: LinearSystem, sample_rate_hz: float, phase: float) -> int:
    """Steps per sample in which the highest mode turns by no more than `phase`, rad; no fewer than 1/phase."""
    squares = scipy.linalg.eigh(system.stiffness, system.mass, eigvals_only=True)
    highest = float(np.sqrt(max(np.max(squares), 0.0)))
    return int(np.clip(np.ceil(highest / sample_rate_hz / phase), np.ceil(1 / phase), MOST_SUBSTEPS))


def between_samples(forces: NDArray[np.float64], factor: int, periodic: bool = False) -> NDArray[np.float64]:
    """Band-limited signals at `factor` points per sample, (n_points, n_forces), for n_samples samples each.

    Parameters
    ----------
    forces : ndarray, (n_forces, n_samples)
    factor : int
    periodic : bool
        True where the record is one period, or several: its end joins its start. The first sample then stands at the
        end once more, so that there are n_samples + 1 of them.
    """
    count = forces.shape[1]
    if periodic:
        fine = _resampled(forces, factor)
        return np.ascontiguousarray(np.concatenate([fine, fine[:, :1]], axis=1).T)
    pad = min(_PADDING, count - 1)
    whole = next_fast_len(count + 2 * pad, real=True)
    before = 2 * forces[:, :1] - forces[:, pad:0:-1]
    after = 2 * forces[:, -1:] - forces[:, -2 : -pad - 2 : -1]
    rest = whole - count - 2 * pad
    # a straight way back to the start, so that the ends of what is transformed meet
    way = after[:, -1:] + (before[:, :1] - after[:, -1:]) * np.arange(1, rest + 1) / (rest + 1)
    fine = _resampled(np.concatenate([before, forces, after, way], axis=1), factor)
    return np.ascontiguousarray(fine[:, pad * factor : (pad + count - 1) * factor + 1].T)


def _resampled(signals: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    count = signals.shape[1]
    spectrum = np.asarray(rfft(signals, axis=1))
    if count % 2 == 0:
        spectrum[:, -1] *= 0.5  # its other half lies at the negative frequency
    return np.asarray(irfft(spectrum, factor * count, axis=1)) * factor


def march(
    system: DrivenSystem,
    sample_rate_hz: float,
    substeps: int,
    force: NDArray[np.float64],
    begin: NDArray[np.float64],
    slopes: Slopes | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """States at every sample, and their derivatives.

    Parameters
    ----------
    system : DrivenSystem
    sample_rate_hz : float
    substeps : int
        Steps per sample.
    force : ndarray, (2·substeps·(n_samples - 1) + 1, n_inputs)
        N, see `between_samples`.
    begin : ndarray, (2n + m,)
    slopes : Slopes, optional

    Returns
    -------
    states : ndarray, (n_samples, 2n + m)
    derivatives : ndarray, (n_samples, 2n + m, p)
        (n_samples, 2n + m, 0) without slopes.
        None where the motion grows without bound.

    References
    ----------
    E. Hairer, S. P. Norsett, G. Wanner, *Solving Ordinary Differential Equations I* (1993), sections II.1 and I.14
    (variational equations).
    """
    if slopes is not None:
        slopes = replace(slopes, begin=slopes.begin[None])
    found = march_windows(system, sample_rate_hz, substeps, force[None], begin[None], slopes)
    return None if found is None else (found[0][0], found[1][0])


def march_windows(
    system: DrivenSystem,
    sample_rate_hz: float,
    substeps: int,
    force: NDArray[np.float64],
    begin: NDArray[np.float64],
    slopes: Slopes | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """`march` under several forces of one length, each from a state of its own.

    Parameters
    ----------
    system, sample_rate_hz, substeps
        As in `march`.
    force : ndarray, (n_windows, 2·substeps·(n_samples - 1) + 1, n_inputs)
    begin : ndarray, (n_windows, 2n + m)
    slopes : Slopes, optional
        Its derivatives of the first state are (n_windows, 2n + m, p).

    Returns
    -------
    states : ndarray, (n_windows, n_samples, 2n + m)
    derivatives : ndarray, (n_windows, n_samples, 2n + m, p)
        None where the motion grows without bound in one of them.
    """
    from ema_pipeline.mechanics import simulation_kernel as kernel  # compiled on first use

    step = 1 / (sample_rate_hz * substeps)
    shape = (len(force), (force.shape[1] - 1) // (2 * substeps) + 1, system.size)
    states = np.empty(shape)
    fixed = (
        system.stiffness, system.damping, system.inputs, system.push, system.rows, system.kinds,
        system.numbers, force, begin, step, substeps,
    )  # fmt: skip
    if slopes is None:
        if not kernel.march_windows(*fixed, states):
            return None
        return states, np.empty((*shape, 0))
    count = slopes.begin.shape[-1]
    width = -(-count // kernel.COLUMNS) * kernel.COLUMNS
    known = kernel.FEW if width == kernel.COLUMNS else ()
    derivatives = np.empty((*shape, width))
    arrays = (*fixed, *(_filled_up(a, width) for a in slopes.arrays), known, states, derivatives)
    if not kernel.march_windows_with_slopes(*arrays):
        return None
    return states, derivatives[..., :count]


def _filled_up(slopes: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Derivatives by `width` parameters, all 0 by those that there are not."""
    found = np.zeros((*slopes.shape[:-1], width))
    found[..., : slopes.shape[-1]] = slopes
    return found


@dataclass(frozen=True)
class Sensors:
    """What sensors read of the states: displacements, velocities, or accelerations.

    Attributes
    ----------
    rows : ndarray, (n_outputs, n)
    quantities : tuple of str
    """

    rows: NDArray[np.float64]
    quantities: Sequence[str]

    def read(
        self,
        system: DrivenSystem,
        states: NDArray[np.float64],
        force: NDArray[np.float64],
        derivatives: NDArray[np.float64] | None = None,
        slopes: Slopes | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Readings (n_samples, n_outputs) and their derivatives (n_samples, n_outputs, p).

        Parameters
        ----------
        system : DrivenSystem
        states : ndarray, (n_samples, 2n + m)
        force : ndarray, (n_samples, n_inputs)
            At the samples, N.
        derivatives : ndarray, (n_samples, 2n + m, p), optional
        slopes : Slopes, optional
            What the derivatives were marched with.
        """
        n, p = len(system.stiffness), 0 if derivatives is None else derivatives.shape[2]
        read = np.empty((len(states), len(self.rows)))
        change = np.empty((len(states), len(self.rows), p))
        rates: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        for o, (row, quantity) in enumerate(zip(self.rows, self.quantities, strict=True)):
            if quantity == "acceleration":
                rates = rates or accelerations(system, states, force, derivatives, slopes)
                source, moved = rates
            else:
                part = slice(0, n) if quantity == "displacement" else slice(n, 2 * n)
                source = states[:, part]
                moved = np.empty((len(states), n, 0)) if derivatives is None else derivatives[:, part]
            read[:, o] = source @ row
            change[:, o] = np.einsum("tnp,n->tp", moved, row)
        return read, change


def accelerations(
    system: DrivenSystem,
    states: NDArray[np.float64],
    force: NDArray[np.float64],
    derivatives: NDArray[np.float64] | None = None,
    slopes: Slopes | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Accelerations (n_samples, n) at marched states, and their derivatives (n_samples, n, p)."""
    from ema_pipeline.mechanics import simulation_kernel as kernel

    p = 0 if derivatives is None else derivatives.shape[2]
    tangent = np.empty((len(states), system.size, 0)) if derivatives is None else derivatives
    given = slopes or Slopes.none(system, p)
    found: tuple[NDArray[np.float64], NDArray[np.float64]] = kernel.accelerations(
        system.stiffness, system.damping, system.inputs, system.push, system.rows, system.kinds, system.numbers,
        np.ascontiguousarray(force), states, tangent,
        given.stiffness, given.damping, given.inputs, given.push, given.numbers,
    )  # fmt: skip
    return found
