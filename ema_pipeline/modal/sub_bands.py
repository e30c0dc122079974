"""All sub-bands: candidates from the charts, a first guess of all modes, the final fit of each sub-band."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.modal.bands import SubBand, between
from ema_pipeline.modal.compress import Local, Window, compress, compressible
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.engines import MODES_PER_PEAK, SPARE_MODES
from ema_pipeline.modal.fit import (
    Estimate,
    normalised,
    shapes_by_lines,
)
from ema_pipeline.modal.fitted_modes import FittedModes, of_all_rows, of_these_rows, polished
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
from ema_pipeline.modal.segment import SegmentFit, broad, fit_segment
from ema_pipeline.processes import release_memory
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

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
        judge = partial(significant, any_broad=bool(np.any(broad(near))))
        fit = fit_segment(few.data, few.hits, few.noise, near, judge, min(iterations, FIRST_ITERATIONS))
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
            return of_these_rows(few.data, fit, part)
        small = polished(few.data, fit)
        del few, fit  # as large as what all rows then need
        return of_all_rows(lines, small, part, iterations)

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
