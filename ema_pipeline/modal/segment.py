"""Modes of one sub-band: candidates are polished, judged, and polished again without those that fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import (
    Estimate,
    LinearSolution,
    normalised,
    residual_fit,
    solve_linear,
    synthesis,
)
from ema_pipeline.modal.noise import Noise, fit_noise, larger
from ema_pipeline.modal.polish import polish

Real = NDArray[np.float64]


ROUGH = 4
"""Iterations of the polish while there is still something to drop."""


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


Judge = Callable[[FitData, SegmentFit], NDArray[np.bool_]]
"""Tells which modes of a fit to drop now."""


def fit_segment(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    candidates: Estimate,
    judge: Judge,
    iterations: int,
) -> SegmentFit:
    """Polish the candidates of a sub-band until the judge drops none.

    Parameters
    ----------
    data : FitData
    hits : Noise or None
        Noise from the scatter over hits, where known.
    start : Noise
        First guess of the noise.
    candidates : Estimate
    judge : callable
    iterations : int
        Of the polish; 0 keeps the engine's poles.
    """
    estimate = Estimate(candidates.poles, normalised(candidates.participation))
    noise = start
    budget = min(iterations, ROUGH)
    while True:
        weight = noise.weight(data.measured)
        estimate, solution = polish(data, weight, estimate, budget)
        noise = measured_noise(data, hits, estimate, solution, weight)
        solution = solve_linear(data, noise.weight(data.measured), estimate)
        fit = SegmentFit(estimate, solution, noise)
        drop = judge(data, fit) if len(estimate.poles) else np.zeros(0, dtype=bool)
        if drop.any():
            estimate, budget = estimate.take(~drop), min(iterations, ROUGH)
        elif budget == iterations or not len(estimate.poles):
            return fit
        else:  # all stand: converge and judge once more
            budget = iterations


def measured_noise(
    data: FitData, hits: Noise | None, estimate: Estimate, solution: LinearSolution, weight: Real
) -> Noise:
    """Noise from what the fit leaves over, and from the scatter over hits where that is larger."""
    modes = synthesis(data, estimate, solution.shapes)
    model = modes + residual_fit(data, weight, modes)
    n_lines = len(data.omega)
    n_ref = data.measured.shape[1]
    # the fit follows the noise a little: one shape entry per row and mode, and the residual terms
    linear = 2.0 * len(estimate.poles) / max(n_ref, 1) + 8.0
    share = max(1.0 - linear / (2.0 * n_lines), 0.3)
    left = np.abs(data.frf - model) ** 2 / share
    found = fit_noise(left, model, data.measured, inputs_are_rows=data.transposed)
    return found if hits is None else larger(found, hits)
