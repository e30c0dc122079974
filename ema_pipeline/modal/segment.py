"""Modes of one sub-band: candidates are polished, tested against the noise, and searched for in what is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import NDArray

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
Search = Callable[[FitData, Real], Estimate]
"""Finds candidates in FRFs with given weights."""

FALSE_ALARM = 1e-6
"""Probability that noise at one line passes for a mode."""

MAX_DAMPING_STD = 0.35
"""A pole whose damping is not known to this share is not told from noise."""

MAX_DAMPING_RATIO = 0.25
ROUNDS = 3
"""How often what the fit leaves over is searched for missed modes."""


@dataclass(frozen=True)
class SegmentFit:
    """Result on the lines of one sub-band.

    Attributes
    ----------
    estimate : Estimate
    solution : LinearSolution
    noise : Noise
    gain, threshold : ndarray, (n_modes,)
        Growth of χ² without the mode, and what noise would make of it at most.
    """

    estimate: Estimate
    solution: LinearSolution
    noise: Noise
    gain: Real
    threshold: Real


def fit_segment(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    candidates: Estimate,
    search: Search,
    *,
    iterations: int,
) -> SegmentFit:
    """Fit, test and complete the modes of one sub-band.

    Parameters
    ----------
    data : FitData
    hits : Noise or None
        Noise from the scatter over hits, where known.
    start : Noise
        First guess of the noise.
    candidates : Estimate
    search : callable
        Finds candidates in FRFs (used on the residual).
    iterations : int
        Of the polish; 0 keeps the engine's poles.
    """
    fit = _fit_and_prune(data, hits, start, candidates, iterations)
    for _ in range(ROUNDS):
        modes = synthesis(data, fit.estimate, fit.solution.shapes)
        weight = fit.noise.weight(data.measured)
        left = data.frf - modes - residual_fit(data, weight, modes)
        found = search(_with_frf(data, left), weight)
        found = found.take(_is_new(found, fit.estimate))
        if not len(found.poles):
            break
        trial = _fit_and_prune(data, hits, fit.noise, fit.estimate.joined(found), iterations)
        if len(trial.estimate.poles) <= len(fit.estimate.poles):
            break
        fit = trial
    return fit


def _is_new(found: Estimate, known: Estimate) -> NDArray[np.bool_]:
    """Candidates that are not on top of a known mode (whose misfit they would only mend)."""
    if not len(known.poles):
        return np.ones(len(found.poles), dtype=bool)
    distance = np.abs(found.poles[:, None] - known.poles[None])
    return np.asarray((distance > 0.5 * np.abs(known.poles.real)[None]).all(axis=1))


def _with_frf(data: FitData, frf: NDArray[np.complex128]) -> FitData:
    return FitData(data.omega, frf, data.variance, data.measured, data.rest_s, data.transposed)


def _fit_and_prune(
    data: FitData, hits: Noise | None, start: Noise, candidates: Estimate, iterations: int
) -> SegmentFit:
    """Polish and drop modes that the FRFs do not need, the least needed first."""
    estimate = Estimate(candidates.poles, normalised(candidates.participation))
    noise = start
    while True:
        weight = noise.weight(data.measured)
        estimate, solution = polish(data, weight, estimate, min(iterations, 6))
        noise = measured_noise(data, hits, estimate, solution, weight)
        weight = noise.weight(data.measured)
        estimate, solution = polish(data, weight, estimate, iterations)
        noise = measured_noise(data, hits, estimate, solution, weight)
        solution = solve_linear(data, noise.weight(data.measured), estimate)
        gain, threshold = significance(data, noise, estimate, solution)
        worst = _worst(data, estimate, solution, gain, threshold)
        if worst is None:
            return SegmentFit(estimate, solution, noise, gain, threshold)
        keep = np.ones(len(estimate.poles), dtype=bool)
        keep[worst] = False
        estimate = estimate.take(keep)


def _worst(
    data: FitData, estimate: Estimate, solution: LinearSolution, gain: Real, threshold: Real
) -> int | None:
    """Index of the mode that is least a mode, or None where all stand."""
    if not len(estimate.poles):
        return None
    poles = estimate.poles
    score = gain / threshold
    zeta = -poles.real / np.abs(poles)
    outside = (poles.imag < data.omega[0]) | (poles.imag > data.omega[-1])
    impossible = (poles.real >= 0) | (zeta > MAX_DAMPING_RATIO) | outside
    score = np.where(impossible, -1.0, score)
    information = newton_step(estimate, solution).information
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * scale[:, None] * scale[None], rcond=1e-12)
    std = np.sqrt(0.5 * np.maximum(np.diag(inverse), 0)) * scale
    vague = std[0 : 2 * len(poles) : 2] / np.abs(poles.real)
    score = np.where(vague > MAX_DAMPING_STD, np.minimum(score, 0.9 * MAX_DAMPING_STD / vague), score)
    worst = int(np.argmin(score))
    return worst if score[worst] < 1 else None


def measured_noise(
    data: FitData, hits: Noise | None, estimate: Estimate, solution: LinearSolution, weight: Real
) -> Noise:
    """Noise from what the fit leaves over, and from the scatter over hits where that is larger."""
    modes = synthesis(data, estimate, solution.shapes)
    model = modes + residual_fit(data, weight, modes)
    n_lines = len(data.omega)
    n_rows, n_ref = data.measured.shape
    # the fit follows the noise a little: one shape entry per row and mode, and the residual terms
    linear = 2.0 * len(estimate.poles) / max(n_ref, 1) + 4.0
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
