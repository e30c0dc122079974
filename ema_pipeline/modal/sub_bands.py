"""All sub-bands: candidates from the charts, a first guess of all modes, the final fit of each sub-band."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.modal.all_rows import linear_fit, placed
from ema_pipeline.modal.bands import SubBand
from ema_pipeline.modal.compress import Local, Window, compress, compressible
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.engines import MODES_PER_PEAK, SPARE_MODES
from ema_pipeline.modal.fit import (
    Estimate,
    Step,
    free_participations,
    newton_step,
    normalised,
    shapes_by_lines,
)
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
from ema_pipeline.modal.missed import Search, missed
from ema_pipeline.modal.mode_acceptance import (
    COINCIDENT,
    MIN_VOTES,
    PLAIN_DAMPING,
    SURE_VOTES,
    credible,
    evident,
    significant,
)
from ema_pipeline.modal.noise import NoiseLaw
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks, at_peak
from ema_pipeline.modal.pole_tracks import link, votes
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.segment import SegmentFit, fit_segment
from ema_pipeline.processes import release_memory
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

AT_REST = 4.0
"""Squared step left to go, in standard deviations, below which a pole is in its place."""

ROUNDS = 2
"""How often a sub-band is searched for missed modes."""

FIRST_ITERATIONS = 4
"""Iterations of the first guess, which only serves to take far modes off the data."""


@dataclass(frozen=True)
class Candidates:
    """Poles that stand for the tracks of all charts.

    Attributes
    ----------
    sure : Estimate
        Shown by most model orders: the fit starts from these.
    weak : Estimate
        Shown by some: they are tried on top of a good fit, where they can be judged fairly.
    """

    sure: Estimate
    weak: Estimate


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


def whole(data: FitData, noise: NoiseLaw, from_hits: bool) -> Window:
    """All lines, with no mode taken off."""
    n_rows, n_ref = data.measured.shape
    none = Estimate(np.zeros(0, complex), np.zeros((0, n_ref), complex))
    return Window(data, noise, from_hits, none, np.zeros((n_rows, 0), complex))


def candidates(charts: list[PoleSet], bands: tuple[SubBand, ...], n_references: int) -> Candidates:
    """Candidates from the core of every sub-band's chart."""
    sure = weak = Estimate(np.zeros(0, complex), np.zeros((0, n_references), complex))
    for poles, part in zip(charts, bands, strict=True):
        tracks = link(poles)
        index = tracks.representative
        core = between(poles.pole[index], part.low, part.high)
        slight = (poles.damping_ratio[index] > PLAIN_DAMPING) & (tracks.votes < MIN_VOTES)
        chosen = np.flatnonzero(core & ~slight)
        # the best supported: many more than peaks are no modes, and a fit of all of them takes minutes
        best = np.argsort(-tracks.votes[chosen], kind="stable")[: MODES_PER_PEAK * part.n_peaks + SPARE_MODES]
        chosen = np.sort(chosen[best])
        index, share = index[chosen], tracks.votes[chosen]
        all_ = Estimate(poles.pole[index], normalised(poles.participation[index]))
        sure = _stitched(sure, all_.take(share >= SURE_VOTES))
        weak = weak.joined(all_.take(share < SURE_VOTES))
    return Candidates(sure, weak)


def tracked(poles: PoleSet) -> Estimate:
    """Every pole that stands for a track of a chart."""
    index = link(poles).representative
    return Estimate(poles.pole[index], normalised(poles.participation[index]))


def between(poles: Complex, low: float, high: float) -> NDArray[np.bool_]:
    """True for poles between two frequencies, rad/s."""
    return np.asarray((poles.imag >= low) & (poles.imag < high))


def _stitched(known: Estimate, fresh: Estimate) -> Estimate:
    """Join the modes of the next sub-band; one that was found on both sides of the seam counts once."""
    if not len(known.poles) or not len(fresh.poles):
        return known.joined(fresh)
    last, first = known.poles[-1], fresh.poles[0]
    same = abs(last - first) < COINCIDENT * min(-last.real, -first.real)
    a, b = known.participation[-1], fresh.participation[0]
    alike = abs(np.vdot(a, b)) ** 2 > 0.8 * np.vdot(a, a).real * np.vdot(b, b).real
    return known.joined(fresh.take(np.arange(1, len(fresh.poles)))) if same and alike else known.joined(fresh)


def first_guess(window: Window, bands: tuple[SubBand, ...], modes: Estimate, iterations: int) -> Estimate:
    """Fit of each sub-band on its own, so that far modes can then be taken off the data of the others."""
    found = modes.take(np.zeros(len(modes.poles), dtype=bool))
    for part in bands:
        few = compress(window.lines(part.first, part.stop))
        release_memory()
        near = modes.take(between(modes.poles, few.data.omega[0], few.data.omega[-1]))
        fit = fit_segment(few.data, few.hits, few.noise, near, significant, min(iterations, FIRST_ITERATIONS))
        found = _stitched(found, fit.estimate.take(between(fit.estimate.poles, part.low, part.high)))
    return found


def refined(
    window: Window,
    bands: tuple[SubBand, ...],
    charts: list[PoleSet],
    sure: Estimate,
    weak: Estimate,
    search: Search,
    iterations: int,
    peaks: KnownPeaks = NO_PEAKS,
    plain: KnownPeaks = NO_PEAKS,
    wanted: KnownPeaks = NO_PEAKS,
) -> FittedModes:
    """Final fit, sub-band by sub-band, with the modes of the other sub-bands taken off the data.

    `peaks` make one mode each, as single hits show; each of the `plain` ones makes a mode at least, and each of the
    `wanted` ones makes one whatever the tests on candidates say.
    """
    data = window.data
    everywhere = _shapes(window, sure)

    def of_part(at: tuple[SubBand, PoleSet]) -> FittedModes | None:
        part, chart = at
        low, high = float(data.omega[part.first]), float(data.omega[part.stop - 1])
        near, also = between(sure.poles, low, high), between(weak.poles, low, high)
        inside = np.concatenate([sure.poles[near], weak.poles[also]])
        seen, asked = plain.between(part.low, part.high), wanted.between(part.low, part.high)
        if (
            not window.from_hits
            and not len(seen.poles)
            and not len(asked.poles)
            and not between(inside, part.low, part.high).any()
        ):
            return None
        lines = replace(
            window.lines(part.first, part.stop), far=sure.take(~near), far_shapes=everywhere[:, ~near]
        )
        few = compress(lines)
        release_memory()  # small pieces of many blocks, which none of the large arrays that follow could take
        fit = _fit_part(few, sure.take(near), weak.take(also), _voters(chart), search, iterations, peaks)
        fit = _with_peaks(few, fit, seen.absent(fit.estimate), _voters(chart), iterations, peaks)
        fit = _with_wanted(few, fit, asked.absent(fit.estimate), iterations, peaks)
        if not len(fit.estimate.poles):
            return None
        if not compressible(data):
            return _of_these_rows(few.data, fit, part)
        polished = _polished(few.data, fit)
        del few, fit  # as large as what all rows then need
        return _of_all_rows(lines, polished, part, iterations)

    # of many rows one sub-band alone fills the memory, and what is done row by row keeps all processors busy
    in_turn = map if compressible(data) else in_order
    parts = [p for p in in_turn(of_part, list(zip(bands, charts, strict=True))) if p is not None]
    n_rows, n_ref = data.measured.shape
    empty = FittedModes(
        np.zeros(0, complex),
        np.zeros((0, 2, 2)),
        np.zeros((0, n_rows), complex),
        np.zeros((0, n_rows)),
        np.zeros((0, n_rows)),
        np.zeros((0, n_ref), complex),
        np.zeros((0, n_ref)),
        np.zeros(0, dtype=bool),
        np.zeros(0, complex),
        np.zeros(0, dtype=bool),
    )
    return FittedModes(
        *(np.concatenate([getattr(p, f.name) for p in [empty, *parts]]) for f in fields(FittedModes))
    )


def _voters(poles: PoleSet) -> Callable[[Estimate], Real]:
    """Share of the orders of a chart that show each mode of an estimate."""
    return lambda estimate: votes(poles, estimate.poles)[0]


def _shapes(window: Window, estimate: Estimate) -> Complex:
    """Shapes that fit best on all lines, (n_rows, n_modes)."""

    def known(lines: slice) -> tuple[Complex, Real]:
        some = window.lines(lines.start, lines.stop).near()
        return some.data.frf, some.noise.weight(some.data.measured)

    return shapes_by_lines(window.data, known, window.data.line_blocks(), estimate).shapes


def _fit_part(
    few: Local,
    sure: Estimate,
    weak: Estimate,
    voters: Callable[[Estimate], Real],
    search: Search,
    iterations: int,
    peaks: KnownPeaks,
) -> SegmentFit:
    """Sure modes first, then weak and missed ones on top."""
    small, hits = few.data, few.hits
    judge = partial(credible, hits=hits, votes=voters, peaks=peaks)
    fitted = partial(
        fit_segment, judge=judge, iterations=iterations, evident=partial(evident, votes=voters), peaks=peaks
    )
    fit = fitted(small, hits, few.noise, sure)
    free = _apart(weak, fit.estimate)
    if free.any():
        more = fitted(small, hits, fit.noise, fit.estimate.joined(weak.take(free)))
        if _holds(more.estimate, fit.estimate):
            fit = more
    for _ in range(ROUNDS if hits is not None else 0):
        assert hits is not None
        extra = missed(small, hits, fit.estimate, fit.solution, search)
        extra = extra.take(_apart(extra, fit.estimate))
        if not len(extra.poles):
            break
        more = fitted(small, hits, fit.noise, fit.estimate.joined(extra))
        if not _holds(more.estimate, fit.estimate) or len(more.estimate.poles) <= len(fit.estimate.poles):
            break
        fit = more
    return fit


def _with_peaks(
    few: Local,
    fit: SegmentFit,
    absent: KnownPeaks,
    voters: Callable[[Estimate], Real],
    iterations: int,
    peaks: KnownPeaks,
) -> SegmentFit:
    """The fit with modes at plain peaks that it has lost, held where the peaks show them."""
    if not len(absent.poles):
        return fit
    start = fit.estimate
    for pole in absent.poles:
        start = start.joined(at_peak(few.data, complex(pole)))
    known = peaks.joined(absent)
    more = fit_segment(
        few.data,
        few.hits,
        fit.noise if len(fit.estimate.poles) else few.noise,
        start,
        partial(credible, hits=few.hits, votes=voters, peaks=known),
        iterations,
        evident=partial(evident, votes=voters),
        peaks=known,
        placed=np.isin(start.poles, absent.poles),
    )
    return more if len(more.estimate.poles) > len(fit.estimate.poles) else fit


def _with_wanted(
    few: Local, fit: SegmentFit, absent: KnownPeaks, iterations: int, peaks: KnownPeaks
) -> SegmentFit:
    """The fit with modes at wanted poles that it lacks, polished with the others unless that drives them away."""
    if not len(absent.poles):
        return fit
    start = fit.estimate
    for pole in absent.poles:
        start = start.joined(at_peak(few.data, complex(pole)))
    return fit_segment(
        few.data,
        few.hits,
        fit.noise if len(fit.estimate.poles) else few.noise,
        start,
        lambda data, found: np.zeros(len(found.estimate.poles), dtype=bool),
        iterations,
        evident=lambda data, estimate, solution: np.ones(len(estimate.poles), dtype=bool),
        peaks=peaks.joined(absent),
    )


def _apart(weak: Estimate, known: Estimate) -> NDArray[np.bool_]:
    """Weak candidates that do not sit on a known mode."""
    if not len(known.poles):
        return np.ones(len(weak.poles), dtype=bool)
    distance = np.abs(weak.poles[:, None] - known.poles[None])
    return np.asarray((distance > COINCIDENT * -known.poles.real).all(axis=1))


def _holds(larger: Estimate, smaller: Estimate) -> bool:
    """True where every mode of the smaller set is still in the larger one, within its bandwidth, none for two."""
    if len(larger.poles) < len(smaller.poles):
        return False
    lost = np.abs(smaller.poles[:, None] - larger.poles[None]) >= -2 * smaller.poles.real[:, None]
    return not lost[linear_sum_assignment(lost)].any()


@dataclass(frozen=True)
class _Polished:
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


def _polished(few: FitData, fit: SegmentFit) -> _Polished:
    covariance = None if few.transposed else _covariance(few, fit)
    return _Polished(fit.estimate, fit.held, fit.away, newton_step(fit.estimate, fit.solution), covariance)


def _covariance(data: FitData, fit: SegmentFit) -> Real:
    """Covariance of poles and participations by noise."""
    weight = fit.noise.weight(data.measured)
    return parameter_covariance(data, weight, fit.estimate, fit.solution, fit.noise)


def _of_these_rows(data: FitData, fit: SegmentFit, part: SubBand) -> FittedModes:
    """Modes of a sub-band's core with their uncertainties, from a fit that had all rows."""
    step = newton_step(fit.estimate, fit.solution)
    scatter = scatter_over_points(scores_of_points(data.transposed, fit.estimate, fit.solution))
    parameters = _widened(_covariance(data, fit), scatter)
    shapes = _shapes_and_stds(data, fit, parameters)
    return _core(part, fit.estimate, (fit.held, fit.away), (step, step), parameters, shapes)


def _of_all_rows(window: Window, fit: _Polished, part: SubBand, iterations: int) -> FittedModes:
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
    return _core(part, estimate, (held, fit.away), (fit.step, step), parameters, (shapes, stds, own))


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
