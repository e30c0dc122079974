"""What the final fit of a sub-band leaves of its modes: poles, shapes, participations, and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.all_rows import backgrounds, linear_fit, placed
from ema_pipeline.modal.bands import SubBand, between
from ema_pipeline.modal.compress import Window
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, Step, free_participations, newton_step
from ema_pipeline.modal.fit_covariance import (
    PointScores,
    left_to_go,
    of_all_blocks,
    own_share,
    parameter_covariance,
    sandwich,
    scatter_of_scores,
    scatter_over_points,
    scores_of_points,
    shape_covariance,
)
from ema_pipeline.modal.segment import SegmentFit
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

AT_REST = 4.0
"""Squared step left to go, in standard deviations, below which a pole is in its place."""


@dataclass(frozen=True)
class FittedModes:
    """Final modes before they are scaled: one entry per mode.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
    pole_cov : ndarray, (n_modes, 2, 2)
        Covariance of (Re s, Im s).
    shapes, shape_stds, shape_own : (n_modes, n_rows)
        The last one is the share of the variance that entries of a shape do not have in common.
    participation, participation_stds : (n_modes, n_references)
    held : ndarray of bool, (n_modes,)
        True where the polish has found no place for a mode: its pole is the one that the model orders give.
    away : complex ndarray, (n_modes,)
        How far the polish would have driven the poles that stay at their peaks, rad/s.
    restless : ndarray of bool, (n_modes,)
        True where the fit has not come to rest.
    """

    poles: Complex
    pole_cov: Real
    shapes: Complex
    shape_stds: Real
    shape_own: Real
    participation: Complex
    participation_stds: Real
    held: NDArray[np.bool_]
    away: Complex
    restless: NDArray[np.bool_]

    def take(self, keep: NDArray[np.bool_]) -> FittedModes:
        """The modes that `keep` picks."""
        return FittedModes(*(getattr(self, f.name)[keep] for f in fields(self)))


@dataclass(frozen=True)
class Polished:
    """What is kept of a fit of combinations of rows: nothing as large as its data.

    Attributes
    ----------
    estimate : Estimate
    held : ndarray of bool, (n_modes,)
    away : complex ndarray, (n_modes,)
    step : Step
        That the fit would still take.
    covariance : ndarray, (n_parameters, n_parameters), or None
        By noise; None where all rows give it.
    """

    estimate: Estimate
    held: NDArray[np.bool_]
    away: Complex
    step: Step
    covariance: Real | None


def polished(few: FitData, fit: SegmentFit) -> Polished:
    """What is kept of a fit to the few rows of a sub-band, with the covariance of its poles where it can be had."""
    covariance = None if few.transposed else _covariance(few, fit)
    return Polished(fit.estimate, fit.held, fit.away, newton_step(fit.estimate, fit.solution), covariance)


def _covariance(data: FitData, fit: SegmentFit) -> Real:
    """Covariance of poles and participations by noise."""
    weight = fit.noise.weight(data.measured)
    return parameter_covariance(data, weight, fit.estimate, fit.solution, fit.noise)


def of_these_rows(data: FitData, fit: SegmentFit, part: SubBand) -> FittedModes:
    """Modes of a sub-band's core with their uncertainties, from a fit that had all rows."""
    step = newton_step(fit.estimate, fit.solution)
    scatter = scatter_over_points(scores_of_points(data.transposed, fit.estimate, fit.solution))
    parameters = _widened(_covariance(data, fit), scatter)
    shapes = _shapes_and_stds(data, fit, parameters)
    return _core(part, fit.estimate, (fit.held, fit.away), (step, step), parameters, shapes)


def of_all_rows(window: Window, fit: Polished, part: SubBand, iterations: int) -> FittedModes:
    """The same from a fit of combinations of rows."""
    transposed, blocks = window.data.transposed, window.data.row_blocks()
    estimate, held, step, first = fit.estimate, fit.held, fit.step, fit.covariance
    if first is None:
        estimate, held = placed(window, estimate, held, iterations)
        linear = list(in_order(lambda rows: linear_fit(window.rows(rows), estimate), blocks))
        points = of_all_blocks(
            [scores_of_points(transposed, estimate, one.solution) for _, one in linear], transposed
        )
        first = sandwich(np.sum([_noise_of(*one) for one in linear], axis=0), points.information)
        parameters = _widened(first, scatter_over_points(points))
        some = [_shapes_and_stds(*one, first) for one in linear]
        step = points.step
    else:

        def of_rows(rows: slice) -> tuple[tuple[Complex, Real, Real], PointScores]:
            data, one = linear_fit(window.rows(rows), estimate)
            scores = scores_of_points(transposed, estimate, one.solution)
            return _shapes_and_stds(data, one, first), scores

        each = list(in_order(of_rows, blocks))
        some = [shapes for shapes, _ in each]
        points = of_all_blocks([told for _, told in each], transposed)
        parameters = _widened(first, scatter_over_points(points))
    shapes, stds, own = (np.concatenate(x) for x in zip(*some, strict=True))
    found = _core(part, estimate, (held, fit.away), (fit.step, step), parameters, (shapes, stds, own))
    # where all rows find no place for a pole, it is a mode only if it has a peak
    driven = (held & ~fit.held)[between(estimate.poles, part.low, part.high)]
    return found.take(~(driven & backgrounds(window.data, Estimate(found.poles, found.participation))))


def _core(
    part: SubBand,
    estimate: Estimate,
    kept: tuple[NDArray[np.bool_], Complex],
    steps: tuple[Step, Step],
    parameters: Real,
    shapes: tuple[Complex, Real, Real],
) -> FittedModes:
    """The modes of a sub-band's core.

    `kept` tells modes that are held, and how far the polish would have driven them; `steps` are those that the fit
    and all rows would still take.
    """
    held, away = kept
    core = np.flatnonzero(between(estimate.poles, part.low, part.high))
    pole_cov = np.array([parameters[2 * r : 2 * r + 2, 2 * r : 2 * r + 2] for r in core]).reshape(-1, 2, 2)
    m = len(estimate.poles)
    # a held pole is as far from its place as the fit that drove it away would have it
    driven, rest = (left_to_go(x)[: 2 * m].reshape(-1, 2) for x in steps)
    rest = np.where(held[:, None], driven, rest)[core]
    far = np.einsum("ra,rab,rb->r", rest, np.linalg.pinv(pole_cov), rest)
    return FittedModes(
        poles=estimate.poles[core],
        pole_cov=pole_cov + rest[:, :, None] * rest[:, None, :],
        shapes=shapes[0].T[core],
        shape_stds=shapes[1].T[core],
        shape_own=shapes[2].T[core],
        participation=estimate.participation[core],
        participation_stds=_participation_stds(estimate, parameters)[core],
        held=held[core],
        away=away[core],
        restless=far > AT_REST,
    )


def _noise_of(data: FitData, fit: SegmentFit) -> Real:
    """What noise makes of the gradient of some rows."""
    return scatter_of_scores(data, fit.noise.weight(data.measured), fit.estimate, fit.solution, fit.noise)


def _widened(covariance: Real, scatter: Real) -> Real:
    """A covariance with each variance raised to that of the scatter, (n_parameters,), where that is larger."""
    own = np.diag(covariance)
    factor = np.sqrt(np.maximum(scatter / np.where(own > 0, own, np.inf), 1.0))
    return np.asarray(covariance * factor[:, None] * factor)


def _shapes_and_stds(data: FitData, fit: SegmentFit, parameters: Real) -> tuple[Complex, Real, Real]:
    """Shapes of some rows, their standard deviations, and the share of the variance that is their own, (n_rows,
    n_modes).
    """
    cov = shape_covariance(data, fit.estimate, fit.solution, fit.noise, parameters)
    diagonal = np.einsum("oaa->oa", cov)
    stds = np.sqrt(0.5 * (diagonal[:, 0::2] + diagonal[:, 1::2]))
    return fit.solution.shapes, stds, own_share(data, fit.estimate, fit.noise)


def _participation_stds(estimate: Estimate, parameters: Real) -> Real:
    m = len(estimate.poles)
    out = np.zeros(estimate.participation.shape)
    for k, (r, i) in enumerate(free_participations(estimate)):
        j = 2 * m + 2 * k
        out[r, i] = np.sqrt(max(0.5 * (parameters[j, j] + parameters[j + 1, j + 1]), 0.0))
    return out
