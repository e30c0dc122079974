"""Spectra of responses to hammer blows, nonlinear elements included, without the signals themselves.

Only the elements' forces and the states at the end of the record are found by going through time: the rest is the
response of a linear system to known forces, which has a closed form at every line of a spectrum.

For one mode y₊ = Ey + Bu from step to step, with u the forces at a step's start (`mechanics.kernel.march`). With s
steps per sample, N samples Δ apart, Q = exp(-Δ/fade - 2πin/N) at line n and Uⱼ the lines of the forces j steps after
each sample but the last, the sum of yQᵏ over the samples is

    (y₀ - Eˢ·y_last·Qᴺ + Q·Σⱼ Eˢ⁻¹⁻ʲ·B·Uⱼ) / (1 - EˢQ).

A mode and its conjugate together have real coefficients before (1 - Re(Eˢ)·Q)/D and Im(Eˢ)·Q/D, with
D = 1 - 2·Re(Eˢ)·Q + |Eˢ|²·Q².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.batch import ORDERS, Blows, fine_force, marched, one_by_one, prepared
from ema_pipeline.mechanics.sampling import band_limited


def batch_lines(
    assemblies: Sequence[Assembly],
    blows: Blows,
    substeps: int,
    fade_s: float,
    lines: NDArray[np.int64],
) -> NDArray[np.complex128]:
    """Lines of the spectra of what `batch_response` gives.

    Line n of a signal x is the sum of x(t)·exp(-t/fade_s - 2πint/T) over the samples of a record of length T. Elements
    with a memory take the way through `batch_response`.

    Parameters
    ----------
    assemblies : sequence of Assembly
    blows : Blows
    substeps : int
    fade_s : float
    lines : ndarray of int, (n_lines,)

    Returns
    -------
    complex ndarray, (n_assemblies, n_blows, n_outputs, n_lines)
        NaN for an assembly whose motion grows without bound.

    Raises
    ------
    EmaError
        For structural damping; where an element with a memory has no solution.
    """
    record = _Record(blows.force.shape[1], substeps, fade_s * blows.sample_rate_hz, lines)
    if any(e.law is None for a in assemblies for e in a.nonlinear):
        return record.lines_of(one_by_one(assemblies, blows, substeps))
    from ema_pipeline.mechanics.kernel import drive  # compiles at its first use

    step = 1 / (blows.sample_rate_hz * substeps)
    _, force = fine_force(blows.force, substeps)
    orders = np.array([ORDERS[q] for q in blows.quantities])
    batch = prepared(assemblies, blows.out_rows, orders, blows.in_rows)
    found = marched(batch, batch.outputs[:, :0], force, step, substeps, trace=True)
    sensed = band_limited(found.forces, substeps)

    hits, channels = len(force), len(blows.out_rows)
    _, first_hits, at = np.unique(blows.in_rows, axis=0, return_index=True, return_inverse=True)
    inputs = np.concatenate([first_hits, np.arange(hits, batch.inputs.shape[1])])
    of_blows, at_once = record.phases_of(force), record.lines_of(blows.force)
    later = np.arange(substeps)[::-1, None, None]
    result = np.empty((len(assemblies), hits, channels, len(lines)), dtype=complex)
    for a in range(len(assemblies)):
        if found.failed[a]:
            result[a] = np.nan
            continue
        decay, outputs = np.exp(batch.poles[a] * step), batch.outputs[a]
        begun, ended, forces = found.begun[a], found.ended[a], sensed[a]
        functions = record.functions(decay**substeps)
        # the blows themselves reach accelerometers as recorded, not as straight lines from step to step
        direct = batch.direct[a].copy()
        direct[:, :hits] = 0
        instant = (outputs @ ended.T).real + direct
        states = found.last[a].reshape(hits, 2, -1)
        last = instant[:, :hits] * force[:, -1] + instant[:, hits:] @ forces[..., -1].T
        ends = -ended[:hits] * force[:, :1] - record.end * decay**substeps * (
            states[:, 0] + 1j * states[:, 1]
        )
        free = _over(outputs, ends, functions, record.end * last)
        into = (begun[inputs] * decay**later).reshape(-1, len(decay))
        now = np.zeros((channels, substeps, len(inputs)))
        now[:, 0] = instant[:, inputs]
        transfer = _over(outputs, into, functions, now.reshape(channels, -1))
        transfer = transfer.reshape(channels, substeps, len(inputs), len(lines))
        of_elements, of_hits = record.phases_of(forces), batch.direct[a][:, :hits]
        drive(free, transfer, of_blows, of_elements, at.reshape(-1), of_hits, at_once, result[a])
    return result


def faded_lines(
    signals: NDArray[np.float64], fade: float, numbers: NDArray[np.int64]
) -> NDArray[np.complex128]:
    """Lines of the spectra of signals (..., n_samples) that are weighted with exp(-k/fade), (..., n_lines)."""
    shade = np.exp(-np.arange(signals.shape[-1]) / fade)
    return np.asarray(scipy.fft.rfft(signals * shade, axis=-1)[..., numbers])


@dataclass(frozen=True)
class _Record:
    """Lines of a record whose samples are weighted with exp(-k/fade)."""

    samples: int
    substeps: int
    fade: float
    numbers: NDArray[np.int64]

    @cached_property
    def turn(self) -> NDArray[np.complex128]:
        """Q of every line."""
        return np.asarray(np.exp(-1 / self.fade - 2j * np.pi * self.numbers / self.samples))

    @property
    def end(self) -> float:
        """Q to the number of samples, at every line."""
        return float(np.exp(-self.samples / self.fade))

    def lines_of(self, signals: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Lines of signals (..., n_samples)."""
        return faded_lines(signals, self.fade, self.numbers)

    def phases_of(self, forces: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Q·Uⱼ of forces (..., n_steps), (substeps, ..., n_lines)."""
        phases = np.zeros((self.substeps, *forces.shape[:-1], self.samples))
        for j in range(self.substeps):
            phases[j, ..., :-1] = forces[..., j :: self.substeps][..., : self.samples - 1]
        return self.lines_of(phases) * self.turn

    def functions(self, decay: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """What `_over` puts coefficients before, for modes with E to the substeps, (2P + 1, n_lines)."""
        q, decay = self.turn, decay[:, None]
        below = 1 - 2 * decay.real * q + np.abs(decay) ** 2 * q**2
        return np.concatenate([(1 - decay.real * q) / below, decay.imag * q / below, 1 / q[None]])


def _over(
    outputs: NDArray[np.complex128],
    inputs: NDArray[np.complex128],
    functions: NDArray[np.complex128],
    instant: NDArray[np.float64],
) -> NDArray[np.complex128]:
    """Lines at outputs (n_outputs, P) of modes that inputs (n, P) move, (n_outputs, n, n_lines).

    `instant`, (n_outputs, n), is what reaches the outputs at once, one sample before the inputs' lines.
    """
    product = outputs[:, None] * inputs
    share = np.concatenate([product.real, -product.imag, instant[..., None]], axis=2)
    flat = share.reshape(-1, share.shape[2]) @ functions.view(np.float64)
    return np.asarray(flat.view(np.complex128).reshape(*share.shape[:2], -1))
