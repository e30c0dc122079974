"""Modes of one sub-band: candidates are polished, judged, and polished again without those that fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FEW_AT_ONCE, FitData
from ema_pipeline.modal.fit import (
    Estimate,
    LinearSolution,
    normalised,
    residual_fit,
    solve_linear,
    synthesis,
)
from ema_pipeline.modal.noise import Noise, fit_law_of_squares, larger, squared
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks
from ema_pipeline.modal.polish import polish
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


ROUGH = 4
"""Iterations of the polish while there is still something to drop."""

MAX_DAMPING_RATIO = 0.5
"""A pole with more is no mode."""

BROAD = 0.2
"""Damping ratio from which a pole mends any misfit."""


@dataclass(frozen=True)
class SegmentFit:
    """Result on the lines of one sub-band.

    Attributes
    ----------
    estimate : Estimate
    solution : LinearSolution
    noise : Noise
    held : ndarray of bool, (n_modes,)
        Modes that the polish would have driven away: they stay where they were before it.
    away : complex ndarray, (n_modes,)
        How far the polish would have driven the poles that stay at their peaks, rad/s; 0 for all others.
    """

    estimate: Estimate
    solution: LinearSolution
    noise: Noise
    held: NDArray[np.bool_]
    away: Complex


Judge = Callable[[FitData, SegmentFit], NDArray[np.bool_]]
"""Tells which modes of a fit to drop now."""

Evident = Callable[[FitData, Estimate, LinearSolution], NDArray[np.bool_]]
"""Tells which modes are there beyond doubt."""


def fit_segment(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    candidates: Estimate,
    judge: Judge,
    iterations: int,
    evident: Evident | None = None,
    peaks: KnownPeaks = NO_PEAKS,
    placed: NDArray[np.bool_] | None = None,
) -> SegmentFit:
    """Polish the candidates of a sub-band until the judge drops none.

    What the polish drives to where no mode can be (no damping, too much of it, out of the band) is dropped, but
    for evident modes: they are put back and held there while the others move on.

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
    evident : callable, optional
        Tells which modes are beyond doubt, whatever the polish makes of them; none where left out.
    peaks : KnownPeaks, optional
        Peaks whose modes are held there where the polish would drive them away.
    placed : ndarray of bool, (n_candidates,), optional
        Candidates that are held where they are from the start.
    """
    estimate = Estimate(candidates.poles, normalised(candidates.participation))
    noise = start
    held = np.zeros(len(estimate.poles), dtype=bool) if placed is None else placed
    away = np.zeros(len(estimate.poles), dtype=np.complex128)
    budget = min(iterations, ROUGH)
    while True:
        weight = noise.weight(data.measured)
        before = estimate
        estimate, best = polish(data, weight, before, budget, held)
        strayed, places = peaks.strayed(before, estimate)
        if (strayed & ~held).any():
            strayed &= ~held
            away = np.where(strayed, estimate.poles - places, away)
            before = Estimate(np.where(strayed, places, before.poles), before.participation)
            estimate, held = put_back(estimate, before, strayed), held | strayed
            continue
        lost = gone_astray(data, before, estimate)
        if evident is not None and lost.any():
            back = put_back(estimate, before, lost)
            lost &= evident(data, back, solve_linear(data, weight, back))
            if lost.any():
                estimate, held = put_back(estimate, before, lost), held | lost
                continue
        noise = measured_noise(data, hits, estimate, best.shapes, weight)
        del weight  # as large as half the data
        solution = solve_linear(data, noise.weight(data.measured), estimate)
        fit = SegmentFit(estimate, solution, noise, held, away)
        drop = judge(data, fit) if len(estimate.poles) else np.zeros(0, dtype=bool)
        if drop.any():
            estimate, held, away = estimate.take(~drop), held[~drop], away[~drop]
            budget = min(iterations, ROUGH)
        elif budget == iterations or not len(estimate.poles):
            return fit
        else:  # all stand: converge and judge once more
            budget = iterations


def impossible(data: FitData, estimate: Estimate) -> NDArray[np.bool_]:
    """Poles that are no modes of the lines analysed, whatever the data say."""
    poles = estimate.poles
    zeta = -poles.real / np.abs(poles)
    outside = (poles.imag < data.omega[0]) | (poles.imag > data.omega[-1])
    return np.asarray((poles.real >= 0) | (zeta > MAX_DAMPING_RATIO) | outside)


def broad(estimate: Estimate) -> NDArray[np.bool_]:
    """Poles with so much damping that they mend any misfit."""
    return np.asarray(-estimate.poles.real > BROAD * np.abs(estimate.poles))


def gone_astray(data: FitData, before: Estimate, estimate: Estimate) -> NDArray[np.bool_]:
    """Poles that the polish has driven to where no mode can be, or no more than a background."""
    lost = impossible(data, estimate) | (broad(estimate) & ~broad(before))
    return np.asarray(lost & ~impossible(data, before))


def put_back(estimate: Estimate, before: Estimate, lost: NDArray[np.bool_]) -> Estimate:
    """The modes as polished, but the lost ones as they were before."""
    participation = np.where(lost[:, None], before.participation, estimate.participation)
    return Estimate(np.where(lost, before.poles, estimate.poles), normalised(participation))


def measured_noise(
    data: FitData, hits: Noise | None, estimate: Estimate, shapes: Complex, weight: Real
) -> Noise:
    """Noise from what the fit leaves over, and from the scatter over hits where that is larger; overwrites `weight`."""
    left, square = weight, np.empty(data.frf.shape)  # what a row leaves goes where its weights were used

    def of_rows(rows: slice) -> None:
        some = data.rows(rows)
        model = synthesis(some, estimate, shapes[rows])
        model += residual_fit(some, weight[rows], model)
        square[rows] = squared(model)
        model -= some.frf
        left[rows] = squared(model)

    for _ in in_order(of_rows, data.row_blocks(FEW_AT_ONCE)):
        pass
    n_lines = len(data.omega)
    n_ref = data.measured.shape[1]
    # the fit follows the noise a little: one shape entry per row and mode, and the residual terms
    linear = 2.0 * len(estimate.poles) / max(n_ref, 1) + len(data.residual_columns())
    share = max(1.0 - linear / (2.0 * n_lines), 0.3)
    left /= share
    found = fit_law_of_squares(left, square, data.measured, inputs_are_rows=data.transposed).at_squares(
        square
    )
    return found if hits is None else larger(found, hits)
