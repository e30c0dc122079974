"""All sub-bands: candidates from the charts, a first guess of all modes, the final fit of each sub-band."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.bands import SubBand
from ema_pipeline.modal.compress import compress
from ema_pipeline.modal.credibility import (
    COINCIDENT,
    MIN_VOTES,
    PLAIN_DAMPING,
    SURE_VOTES,
    credible,
    significant,
)
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, free_participations, normalised, solve_linear, synthesis
from ema_pipeline.modal.missed import Search, missed
from ema_pipeline.modal.noise import Noise
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.segment import SegmentFit, fit_segment
from ema_pipeline.modal.selection import link, votes
from ema_pipeline.modal.uncertainty import covariance

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


@dataclass(frozen=True)
class FittedModes:
    """Final modes before they are scaled: one entry per mode.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
    pole_cov : ndarray, (n_modes, 2, 2)
        Covariance of (Re s, Im s).
    shapes, shape_stds : (n_modes, n_rows)
    participation, participation_stds : (n_modes, n_references)
    """

    poles: Complex
    pole_cov: Real
    shapes: Complex
    shape_stds: Real
    participation: Complex
    participation_stds: Real


@dataclass(frozen=True)
class NoiseModels:
    """Noise of all FRFs on all lines.

    Attributes
    ----------
    hits : Noise or None
        From the scatter over hits, where known.
    start : Noise
        The same, or a first guess.
    """

    hits: Noise | None
    start: Noise

    def cut(self, part: SubBand) -> NoiseModels:
        """The same on the lines of a sub-band."""
        start = self.start.lines(part.first, part.stop)
        return NoiseModels(None if self.hits is None else self.hits.lines(part.first, part.stop), start)


def candidates(charts: list[PoleSet], bands: tuple[SubBand, ...], n_references: int) -> Candidates:
    """Candidates from the core of every sub-band's chart."""
    sure = weak = Estimate(np.zeros(0, complex), np.zeros((0, n_references), complex))
    for poles, part in zip(charts, bands, strict=True):
        tracks = link(poles)
        index = tracks.representative
        core = between(poles.pole[index], part.low, part.high)
        slight = (poles.damping_ratio[index] > PLAIN_DAMPING) & (tracks.votes < MIN_VOTES)
        index, share = index[core & ~slight], tracks.votes[core & ~slight]
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


def first_guess(
    data: FitData, noise: NoiseModels, bands: tuple[SubBand, ...], modes: Estimate, iterations: int
) -> Estimate:
    """Fit of each sub-band on its own, so that far modes can then be taken off the data of the others."""
    found = modes.take(np.zeros(len(modes.poles), dtype=bool))
    for part in bands:
        lines, local = data.lines(part.first, part.stop), noise.cut(part)
        near = modes.take(between(modes.poles, lines.omega[0], lines.omega[-1]))
        small, hits, start = compress(lines, local.hits, local.start)
        fit = fit_segment(small, hits, start, near, significant, min(iterations, FIRST_ITERATIONS))
        found = _stitched(found, fit.estimate.take(between(fit.estimate.poles, part.low, part.high)))
    return found


def refined(
    data: FitData,
    noise: NoiseModels,
    bands: tuple[SubBand, ...],
    charts: list[PoleSet],
    sure: Estimate,
    weak: Estimate,
    search: Search,
    iterations: int,
) -> FittedModes:
    """Final fit, sub-band by sub-band, with the modes of the other sub-bands taken off the data."""
    parts: list[FittedModes] = []
    everywhere = solve_linear(data, noise.start.weight(data.measured), sure).shapes
    for part, chart in zip(bands, charts, strict=True):
        low, high = float(data.omega[part.first]), float(data.omega[part.stop - 1])
        near, also = between(sure.poles, low, high), between(weak.poles, low, high)
        inside = np.concatenate([sure.poles[near], weak.poles[also]])
        if noise.hits is None and not between(inside, part.low, part.high).any():
            continue
        lines = data.lines(part.first, part.stop)
        far = synthesis(lines, sure.take(~near), everywhere[:, ~near])
        lines = replace(lines, frf=np.where(lines.measured[..., None], lines.frf - far, 0.0))
        fit = _fit_part(
            lines, noise.cut(part), sure.take(near), weak.take(also), _voters(chart), search, iterations
        )
        parts.append(_final(lines, fit, part))
    n_rows, n_ref = data.measured.shape
    empty = FittedModes(
        np.zeros(0, complex),
        np.zeros((0, 2, 2)),
        np.zeros((0, n_rows), complex),
        np.zeros((0, n_rows)),
        np.zeros((0, n_ref), complex),
        np.zeros((0, n_ref)),
    )
    return FittedModes(
        *(np.concatenate([getattr(p, f.name) for p in [empty, *parts]]) for f in fields(FittedModes))
    )


def _voters(poles: PoleSet) -> Callable[[Estimate], Real]:
    """Share of the orders of a chart that show each mode of an estimate."""
    return lambda estimate: votes(poles, estimate.poles)[0]


def _fit_part(
    lines: FitData,
    noise: NoiseModels,
    sure: Estimate,
    weak: Estimate,
    voters: Callable[[Estimate], Real],
    search: Search,
    iterations: int,
) -> SegmentFit:
    """Sure modes first, then weak and missed ones on top; at last all rows where they had been combined."""
    small, hits, start = compress(lines, noise.hits, noise.start)
    judge = partial(credible, hits=hits, votes=voters)
    fit = fit_segment(small, hits, start, sure, judge, iterations)
    free = _apart(weak, fit.estimate)
    if free.any():
        more = fit_segment(small, hits, fit.noise, fit.estimate.joined(weak.take(free)), judge, iterations)
        if _holds(more.estimate, fit.estimate):
            fit = more
    for _ in range(ROUNDS if hits is not None else 0):
        assert hits is not None
        extra = missed(small, hits, fit.estimate, fit.solution, search)
        extra = extra.take(_apart(extra, fit.estimate))
        if not len(extra.poles):
            break
        more = fit_segment(small, hits, fit.noise, fit.estimate.joined(extra), judge, iterations)
        if not _holds(more.estimate, fit.estimate) or len(more.estimate.poles) <= len(fit.estimate.poles):
            break
        fit = more
    if small is lines:
        return fit
    judge = partial(credible, hits=noise.hits, votes=voters)
    return fit_segment(lines, noise.hits, noise.start, fit.estimate, judge, iterations)


def _apart(weak: Estimate, known: Estimate) -> NDArray[np.bool_]:
    """Weak candidates that do not sit on a known mode."""
    if not len(known.poles):
        return np.ones(len(weak.poles), dtype=bool)
    distance = np.abs(weak.poles[:, None] - known.poles[None])
    return np.asarray((distance > COINCIDENT * -known.poles.real).all(axis=1))


def _holds(larger: Estimate, smaller: Estimate) -> bool:
    """True where every mode of the smaller set is still in the larger one, within its bandwidth."""
    if not len(smaller.poles):
        return True
    if not len(larger.poles):
        return False
    distance = np.abs(smaller.poles[:, None] - larger.poles[None]).min(axis=1)
    return bool(np.all(distance < 2 * -smaller.poles.real))


def _final(lines: FitData, fit: SegmentFit, part: SubBand) -> FittedModes:
    """Modes of a sub-band's core with their uncertainties."""
    estimate = fit.estimate
    cov = covariance(lines, fit.noise.weight(lines.measured), estimate, fit.solution, fit.noise)
    core = np.flatnonzero(between(estimate.poles, part.low, part.high))
    stds = np.array(
        [np.sqrt(0.5 * (cov.shapes[:, 2 * r, 2 * r] + cov.shapes[:, 2 * r + 1, 2 * r + 1])) for r in core]
    )
    return FittedModes(
        poles=estimate.poles[core],
        pole_cov=np.array([cov.poles(int(r)) for r in core]).reshape(len(core), 2, 2),
        shapes=fit.solution.shapes.T[core],
        shape_stds=stds.reshape(len(core), len(lines.frf)),
        participation=estimate.participation[core],
        participation_stds=_participation_stds(estimate, cov.parameters)[core],
    )


def _participation_stds(estimate: Estimate, parameters: Real) -> Real:
    m = len(estimate.poles)
    out = np.zeros(estimate.participation.shape)
    for k, (r, i) in enumerate(free_participations(estimate)):
        j = 2 * m + 2 * k
        out[r, i] = np.sqrt(max(0.5 * (parameters[j, j] + parameters[j + 1, j + 1]), 0.0))
    return out
