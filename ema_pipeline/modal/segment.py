"""Modes of one sub-band: candidates are polished and tested."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import (
    Estimate,
    LinearSolution,
    newton_step,
    normalised,
    residual_fit,
    solve_linear,
    synthesis,
)
from ema_pipeline.modal.noise import Noise, fit_noise, larger
from ema_pipeline.modal.polish import polish
from ema_pipeline.modal.uncertainty import evidence

Real = NDArray[np.float64]
Votes = Callable[[Estimate], Real]
"""Share of model orders that show each mode."""

FALSE_ALARM = 1e-6
"""Probability that noise at one line passes for a mode."""

MAX_DAMPING_STD = 0.35
"""A pole whose damping is not known to this share is not told from noise."""

MAX_DAMPING_RATIO = 0.2

MIN_VOTES = 0.3
"""Share of model orders that must show a mode, unless the FRFs show it plainly or the noise is known."""

HOPELESS = 0.3
"""Candidates that reach less than this share of a limit are dropped together, others one at a time."""

PLAIN = 2.0
"""A mode is plain where, at its frequency, its own response has this many times the power of all the rest."""

PLAIN_DAMPING = 0.05
"""Poles with more damping shape a background rather than a peak: they are only taken on votes."""

EXPLAINED = 1.5
"""Misfit around a mode over the scatter between hits, up to which nothing but noise is left over."""

COINCIDENT = 0.3
"""Poles closer than this, in decay rates, coincide."""

SAME_SHAPE = 0.99
"""MAC above which two coinciding poles are one mode."""

SAME_RESPONSE = 0.9
"""The same for shapes at three or more sensors that measured together: between hits the frequency may drift,
which splits a mode in two with one shape at the sensors."""


ECHO_REACH = 10.0
"""Distance from a stronger mode, in its decay rates, within which a pole may be its echo: a mode whose
frequency drifts between hits, or with the level, leaves a misfit that a second pole beside it mends."""

ECHO_MAC = 0.6
"""Product of the MACs at rows and references above which a nearby pole is an echo."""


@dataclass(frozen=True)
class SegmentFit:
    """Result on the lines of one sub-band.

    Attributes
    ----------
    estimate : Estimate
    solution : LinearSolution
    noise : Noise
    """

    estimate: Estimate
    solution: LinearSolution
    noise: Noise


def fit_segment(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    candidates: Estimate,
    votes: Votes,
    iterations: int,
) -> SegmentFit:
    """Polish the candidates of a sub-band and drop those that are no modes, the least likely first.

    Parameters
    ----------
    data : FitData
    hits : Noise or None
        Noise from the scatter over hits, where known.
    start : Noise
        First guess of the noise.
    candidates : Estimate
    votes : callable
        Share of model orders that show each mode of an estimate.
    iterations : int
        Of the polish; 0 keeps the engine's poles.
    """
    estimate = Estimate(candidates.poles, normalised(candidates.participation))
    noise = start
    while True:
        weight = noise.weight(data.measured)
        estimate, solution = polish(data, weight, estimate, iterations)
        noise = measured_noise(data, hits, estimate, solution, weight)
        solution = solve_linear(data, noise.weight(data.measured), estimate)
        doubtful = _doubtful(data, hits, noise, estimate, solution, votes)
        if not doubtful.any():
            return SegmentFit(estimate, solution, noise)
        estimate = estimate.take(~doubtful)


def _doubtful(
    data: FitData,
    hits: Noise | None,
    noise: Noise,
    estimate: Estimate,
    solution: LinearSolution,
    votes: Votes,
) -> NDArray[np.bool_]:
    """Candidates to drop now: all impossible ones, else the hopeless or the worst one."""
    poles = estimate.poles
    if not len(poles):
        return np.zeros(0, dtype=bool)
    zeta = -poles.real / np.abs(poles)
    outside = (poles.imag < data.omega[0]) | (poles.imag > data.omega[-1])
    impossible = (poles.real >= 0) | (zeta > MAX_DAMPING_RATIO) | outside
    if impossible.any():
        return np.asarray(impossible)
    gain, threshold = significance(data, noise, estimate, solution)
    score = np.minimum(gain / threshold, MAX_DAMPING_STD / np.maximum(decay_std(estimate, solution), 1e-9))
    plain = visibility(data, estimate, solution) / PLAIN
    plain = np.where(zeta > PLAIN_DAMPING, 0.0, plain)
    explained = np.zeros(len(poles), dtype=bool)
    if hits is not None:
        explained = misfit(data, hits, estimate, solution) < EXPLAINED
    support = np.maximum(votes(estimate) / MIN_VOTES, plain)
    support = np.where(explained, np.maximum(support, 1.0), support)
    score = np.minimum(score, support)
    doubles = np.flatnonzero(_doubles(data, estimate, solution, explained))
    if len(doubles):  # one at a time: three poles on two modes mix their shapes
        strength = np.linalg.norm(solution.shapes, axis=0) * np.linalg.norm(estimate.participation, axis=1)
        out = np.zeros(len(poles), dtype=bool)
        out[doubles[np.argmin(strength[doubles])]] = True
        return out
    failed = score < 1
    return np.asarray(failed & (score <= max(HOPELESS, score.min())))


def decay_std(estimate: Estimate, solution: LinearSolution) -> Real:
    """Relative standard deviation of each pole's decay rate, from the fit alone."""
    information = newton_step(estimate, solution).information
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * scale[:, None] * scale[None], rcond=1e-12)
    std = np.sqrt(0.5 * np.maximum(np.diag(inverse), 0)) * scale
    return np.asarray(std[0 : 2 * len(estimate.poles) : 2] / np.abs(estimate.poles.real))


def visibility(data: FitData, estimate: Estimate, solution: LinearSolution) -> Real:
    """Power of each mode at its frequency (three lines, all FRFs) over the power of all the rest."""
    out = np.empty(len(estimate.poles))
    for r, pole in enumerate(estimate.poles):
        line = int(np.argmin(np.abs(data.omega - pole.imag)))
        near = data.lines(max(0, line - 1), line + 2)
        own = synthesis(near, estimate.take(np.array([r])), solution.shapes[:, [r]])
        rest = np.where(data.measured[..., None], near.frf - own, 0.0)
        own = np.where(data.measured[..., None], own, 0.0)
        out[r] = np.sum(np.abs(own) ** 2) / max(float(np.sum(np.abs(rest) ** 2)), 1e-300)
    return out


def misfit(data: FitData, hits: Noise, estimate: Estimate, solution: LinearSolution) -> Real:
    """What the fit leaves over around each mode, over what the scatter between hits explains."""
    weight = hits.weight(data.measured)
    modes = synthesis(data, estimate, solution.shapes)
    left = np.abs(data.frf - modes - residual_fit(data, weight, modes)) ** 2 * weight
    ratio = left.sum(axis=(0, 1)) / max(np.count_nonzero(data.measured), 1)
    out = np.empty(len(estimate.poles))
    for r, pole in enumerate(estimate.poles):
        line = int(np.argmin(np.abs(data.omega - pole.imag)))
        reach = int(np.clip(-3 * pole.real / (data.omega[1] - data.omega[0]), 6, 200))
        out[r] = ratio[max(0, line - reach) : line + reach + 1].mean()
    return np.maximum(out, 1e-9)


def _doubles(
    data: FitData, estimate: Estimate, solution: LinearSolution, explained: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The weaker of two poles that are one mode: coinciding with one shape, or an echo of a stronger mode."""
    m = len(estimate.poles)
    rows, references = mac(solution.shapes.T, solution.shapes.T), mac(estimate.participation, estimate.participation)
    sensors, hit = (references, rows) if data.transposed else (rows, references)
    n_sensors = data.measured.shape[1] if data.transposed else data.measured.shape[0]
    if n_sensors == 1:  # nothing measured together: the points hit must tell
        alike = hit > SAME_RESPONSE
    else:
        alike = sensors > (SAME_RESPONSE if n_sensors > 2 else SAME_SHAPE)
    decay = -estimate.poles.real
    close = np.abs(estimate.poles[:, None] - estimate.poles[None]) < COINCIDENT * np.maximum(decay[:, None], decay)
    strength = np.linalg.norm(solution.shapes, axis=0) * np.linalg.norm(estimate.participation, axis=1)
    weaker = strength[:, None] < strength[None]
    double = alike & close
    if min(data.measured.shape) > 2:
        near = np.abs(estimate.poles[:, None] - estimate.poles[None]) < ECHO_REACH * decay[None]
        double |= near & (rows * references > ECHO_MAC) & ~explained[:, None]
    return np.asarray((double & weaker).any(axis=1))


def measured_noise(
    data: FitData, hits: Noise | None, estimate: Estimate, solution: LinearSolution, weight: Real
) -> Noise:
    """Noise from what the fit leaves over, and from the scatter over hits where that is larger."""
    modes = synthesis(data, estimate, solution.shapes)
    model = modes + residual_fit(data, weight, modes)
    n_lines = len(data.omega)
    n_rows, n_ref = data.measured.shape
    # the fit follows the noise a little: one shape entry per row and mode, and the residual terms
    linear = 2.0 * len(estimate.poles) / max(n_ref, 1) + 8.0
    share = max(1.0 - linear / (2.0 * n_lines), 0.3)
    left = np.abs(data.frf - model) ** 2 / share
    found = fit_noise(left, model, data.measured, inputs_are_rows=data.transposed)
    return found if hits is None else larger(found, hits)


def significance(
    data: FitData, noise: Noise, estimate: Estimate, solution: LinearSolution
) -> tuple[Real, Real]:
    """Growth of χ² without each mode, and the growth that noise alone may reach.

    Noise that all outputs share gives them one common chance to look like a mode, not one each; the limit
    is raised by its share at the mode's frequency.
    """
    m = len(estimate.poles)
    if not m:
        return np.zeros(0), np.zeros(0)
    gain, _ = evidence(solution, m)
    rows = int(np.count_nonzero(data.measured.any(axis=1)))
    chance = FALSE_ALARM / len(data.omega)
    free = 2 * rows + 2 * data.measured.shape[1]
    independent = scipy.stats.chi2.isf(chance, free)
    coherent = free / 4 * scipy.stats.chi2.isf(chance, 4)
    at = np.clip(np.searchsorted(data.omega, estimate.poles.imag), 0, len(data.omega) - 1)
    weight = noise.weight(data.measured)
    share = np.einsum("oil,oil->l", noise.common, weight)[at] / max(np.count_nonzero(data.measured), 1)
    return gain, (1 - share) * independent + share * coherent
