"""Which candidates are modes: tests against the noise, the model orders, and each other.

A candidate must stand out of the noise. Beyond that, real structures are never quite linear and never quite
the same from hit to hit, and a fit mends such misfits with poles that are no modes. So a mode must also be
supported: by the model orders that show it, by being plain to see in the FRFs, or because around it nothing
but the scatter between hits is left over.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ema_pipeline.modal.assurance import mac, mpc
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, LinearSolution, newton_step, synthesis
from ema_pipeline.modal.fit_covariance import evidence
from ema_pipeline.modal.heavily_damped import UNSEEN, has_peak, too_broad, unearned
from ema_pipeline.modal.missed import left_over
from ema_pipeline.modal.noise import Noise
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks
from ema_pipeline.modal.segment import SegmentFit, broad, impossible
from ema_pipeline.modal.windowed import likeness

Real = NDArray[np.float64]
Votes = Callable[[Estimate], Real]
"""Share of model orders that show each mode."""

FALSE_ALARM = 1e-6
"""Probability that noise at one line passes for a mode."""

MAX_DAMPING_STD = 0.35
"""A pole whose damping is not known to this share is not told from noise."""

MAX_PLAIN_DAMPING_STD = 0.5
"""The same of a plain mode, which noise has not made: its decay lies two standard deviations from that of a tone."""

MAX_UNSEEN_DAMPING_STD = 0.15
"""The same of a pole that no model order shows, which else mends what a fit leaves over beside another mode."""

MIN_VOTES = 0.3
"""Share of model orders that must show a mode, unless the FRFs show it plainly or the noise is known."""

HOPELESS = 0.5
"""Candidates that reach less than this share of a limit are dropped together, others one at a time."""

SURE_VOTES = 0.6
"""The same for poles that mostly are the fit's way around a misfit: heavily damped ones and twins."""

PLAIN = 2.0
"""A mode is plain where, at its frequency, its own response has this many times the power of all the rest."""

PLAIN_DAMPING = 0.05
"""Poles with more damping that have no peak shape a background: they are only taken on votes."""

EXPLAINED = 1.5
"""Misfit around a mode over the scatter between hits, up to which nothing but noise is left over."""

COINCIDENT = 0.3
"""Poles closer than this, in decay rates, coincide."""

RANK_ONE = 0.05
"""Second over first singular value of the common residue of two coinciding poles, below which they are one
mode, where a misfit is left over. A hundredth of it where the noise explains what is left."""

MIXED_RANK, MIXED_REACH = 0.25, 0.7
"""The same, and the distance in decay rates, where every sensor position has blows of its own on several points: a blow
that is some degrees off its direction excites another mix, so that the residue of one mode has more than one singular
value. At 8°, with hits on frames, second poles reached 0.13 of the first and distances up to 0.6; two modes of such
poles are not told apart."""

TURNED_RANK, TURNED_REACH = 0.55, 0.2
"""The same of poles that nearly coincide: with one hit per turn, and a mode that moves the points struck mostly across
the blows, second poles reached 0.5 of the first, at distances up to 0.16."""

SAME_RESPONSE = 0.9
"""MAC at three or more sensors that measured together, above which two coinciding poles are one mode where a
misfit is left over: its frequency drifts between hits, which splits it in two that look alike."""

ONE_SHAPE = 0.97
"""Least MAC of the same, whatever the scatter between hits explains, for poles within `ONE_SHAPE_REACH`: a frequency
that depends on the amplitude moves within the decay, which two or three poles of one shape follow as exactly as noise
lets one see. So do twins of hits on one point that differ in direction and frequency."""

ONE_SHAPE_REACH = 2.0
"""In the larger of two decay rates: a frequency may move by several half-widths within the decay; the poles that follow
it then decay several times as fast as the mode."""

SHAPE_CHANCE = 0.002
"""Probability by chance that two modes look as alike at few sensors as one does: raises `ONE_SHAPE` where these are
two or three."""

FEW_SENSORS = 2
"""So many cannot tell shapes; decay rates and residues then tell a frequency that moves from two modes."""

DECAY_RATIO = (2.0, 6.0)
"""Decay rate of the second pole over that of the mode whose frequency it follows: three to first order, where the
frequency depends on the square of the amplitude; a large change moves both poles."""

FEW_REACH = 0.8
"""Difference of their frequencies in the larger decay rate: farther off, a second pole makes a shoulder of its own."""

QUADRATURE = 0.7
"""Least sine of the phase between the residues of these two poles: a change of frequency turns the phase of the decay,
so that it is 90°; residues of two modes with real shapes have a phase of 0 or 180°."""

RANDOM_PHASE = 0.25
"""Modal phase collinearity below which the phases of a shape are random."""

MIN_ROWS_FOR_PHASE = 6

ECHO_REACH = 10.0
"""Distance from a stronger mode, in its decay rates, within which a pole may be its echo: a mode whose
frequency drifts between hits, or with the level, leaves a misfit that a second pole beside it mends."""

ECHO_MAC = 0.6
"""Product of the MACs at rows and references above which a nearby pole is an echo."""


def significant(data: FitData, fit: SegmentFit, any_broad: bool = True) -> NDArray[np.bool_]:
    """Candidates to drop from a first guess: impossible ones, else those that noise alone could make.

    Where `any_broad` is False, the polish has made all very heavily damped ones.
    """
    out = impossible(data, fit.estimate)
    if out.any() and not broad(fit.estimate).any():
        return out
    std = decay_std(fit.estimate, fit.solution)
    weight, told = fit.noise.weight(data.measured), np.full(len(std), any_broad)
    out |= too_broad(data, weight, fit.estimate, told, std)
    return out if out.any() else _next(_strength_over_noise(data, fit, std))


def credible(
    data: FitData, fit: SegmentFit, hits: Noise | None, votes: Votes, peaks: KnownPeaks = NO_PEAKS
) -> NDArray[np.bool_]:
    """Candidates to drop from a converged fit: impossible ones, else doubles, else the least credible.

    Parameters
    ----------
    data : FitData
    fit : SegmentFit
    hits : Noise or None
        Noise from the scatter over hits, where known.
    votes : callable
    peaks : KnownPeaks
        Peaks of which single hits show that one mode is there.
    """
    estimate, solution = fit.estimate, fit.solution
    out = impossible(data, estimate) | peaks.echoes(estimate)
    if out.any() and not broad(estimate).any():
        return out
    explained = np.zeros(len(out), dtype=bool)
    if hits is not None:
        explained = misfit(data, hits, estimate, solution) < EXPLAINED
    weight, std = fit.noise.weight(data.measured), decay_std(estimate, solution)
    out |= too_broad(data, weight, estimate, explained, std)
    if out.any():
        return out
    out = _doubles(data, estimate, solution, explained)
    if out.any():
        return out
    zeta = -estimate.poles.real / np.abs(estimate.poles)
    plain = _plainness(data, estimate, solution)
    distance = np.abs(estimate.poles[:, None] - estimate.poles[None]) + np.diag(np.full(len(zeta), np.inf))
    twin = distance.min(axis=1) < COINCIDENT * -estimate.poles.real
    needed = np.where((zeta > PLAIN_DAMPING) | twin, SURE_VOTES, MIN_VOTES)
    share = votes(estimate)
    support = np.maximum(share / needed, np.where(twin, 0.0, plain))
    # any mix of two modes at one pole is a shape of that pole, complex ones too
    random = _incoherent(solution) & ~twin
    support = np.where(random, 0.0, support)
    told = (share > UNSEEN) | ((std < MAX_UNSEEN_DAMPING_STD) & ~random)
    support = np.where(explained & told, np.maximum(support, 1.0), support)
    # where the polish finds no place for a mode, it is one only if most orders and the FRFs show it plainly
    support = np.where(fit.held, np.minimum(plain, share / SURE_VOTES), support)
    support = np.where(unearned(data, weight, estimate, solution, share, explained), 0.0, support)
    support = np.where(peaks.owners(estimate), np.maximum(support, 1.0), support)
    out = _next(np.minimum(_strength_over_noise(data, fit, std), support))
    # one or two sensors tell little: they are asked last, of modes that all else speaks for
    return out if out.any() else _smaller_of_pairs(estimate, solution, _followers(data, estimate, solution))


def evident(data: FitData, estimate: Estimate, solution: LinearSolution, votes: Votes) -> NDArray[np.bool_]:
    """Modes that most orders and the FRFs show plainly."""
    return np.asarray((_plainness(data, estimate, solution) >= 1) & (votes(estimate) >= SURE_VOTES))


def _plainness(data: FitData, estimate: Estimate, solution: LinearSolution) -> Real:
    """Above 1 where the FRFs show a mode plainly; 0 for what only shapes a background."""
    zeta = -estimate.poles.real / np.abs(estimate.poles)
    out = visibility(data, estimate, solution) / PLAIN
    heavy = np.flatnonzero(zeta > PLAIN_DAMPING)
    if len(heavy):
        power = np.sum(np.abs(data.frf) ** 2, axis=(0, 1))
        out[[r for r in heavy if not has_peak(data.omega, power, estimate.poles[r])]] = 0.0
    return np.asarray(out)


def _incoherent(solution: LinearSolution) -> NDArray[np.bool_]:
    """Shapes with random phases: a tone that no blow has started, but that went on during all of them."""
    if len(solution.shapes) < MIN_ROWS_FOR_PHASE:
        return np.zeros(solution.shapes.shape[1], dtype=bool)
    return np.array([mpc(shape) < RANDOM_PHASE for shape in solution.shapes.T])


def _next(score: Real) -> NDArray[np.bool_]:
    """Among candidates with a score below 1, the hopeless ones or the worst one."""
    return np.asarray((score < 1) & (score <= max(HOPELESS, float(score.min()))))


def _strength_over_noise(data: FitData, fit: SegmentFit, std: Real) -> Real:
    """Above 1 where noise cannot have made the candidate, and its damping is known well enough, by its `decay_std`.

    The damping of a mode that the polish could not place is not known, and said to be so.
    """
    gain, threshold = significance(data, fit.noise, fit.estimate, fit.solution)
    std = std * np.sqrt(likeness(-fit.estimate.poles.real, data))
    plain = visibility(data, fit.estimate, fit.solution) >= PLAIN
    most = np.where(plain, MAX_PLAIN_DAMPING_STD, MAX_DAMPING_STD)
    known = np.where(fit.held, np.inf, most / np.maximum(std, 1e-9))
    return np.asarray(np.minimum(gain / threshold, known))


def _size(estimate: Estimate, solution: LinearSolution) -> Real:
    return np.asarray(
        np.linalg.norm(solution.shapes, axis=0) * np.linalg.norm(estimate.participation, axis=1)
    )


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
    ratio = left_over(data, hits, estimate, solution)
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
    sensors, n_sensors = _sensors(data, estimate, solution)
    decay = -estimate.poles.real
    distance = np.abs(estimate.poles[:, None] - estimate.poles[None])
    heavier = _heavier(estimate.poles)
    close = distance < COINCIDENT * heavier
    if data.in_turn and min(data.measured.shape) > 1:
        near = distance < MIXED_REACH * heavier
        least = np.where(distance < TURNED_REACH * heavier, TURNED_RANK, MIXED_RANK)
    else:
        near, least = close, np.where(explained, 0.01 * RANK_ONE, RANK_ONE)[:, None]
    double = near & (_second_singular(estimate, solution, near) < least)
    if n_sensors > 2:
        double |= close & (sensors > SAME_RESPONSE) & ~explained[:, None]
    double |= _one_shape(estimate.poles, sensors, n_sensors)
    if min(data.measured.shape) > 2:
        both = mac(solution.shapes.T, solution.shapes.T) * mac(estimate.participation, estimate.participation)
        double |= (distance < ECHO_REACH * decay) & (both > ECHO_MAC) & ~explained[:, None]
    return _smaller_of_pairs(estimate, solution, double)


def _smaller_of_pairs(
    estimate: Estimate, solution: LinearSolution, double: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The smaller mode of every pair, each mode in one pair at a time, (n_modes,)."""
    size = _size(estimate, solution)
    out = np.zeros(len(size), dtype=bool)
    touched = np.zeros(len(size), dtype=bool)
    # smallest first: three poles on two modes mix their shapes
    for weak in np.argsort(size):
        partners = np.flatnonzero(double[weak] & (size > size[weak]) & ~touched)
        if len(partners) and not touched[weak]:
            out[weak] = True
            touched[partners] = touched[weak] = True
    return out


def _one_shape(poles: NDArray[np.complex128], sensors: Real, n_sensors: int) -> NDArray[np.bool_]:
    """Pairs of near poles that show one shape at several sensors, (n_modes, n_modes).

    Parameters
    ----------
    poles : complex ndarray, (n_modes,)
    sensors : ndarray, (n_modes, n_modes)
        MAC at the sensors that measured together.
    n_sensors : int
    """
    if n_sensors <= FEW_SENSORS:
        return np.zeros(sensors.shape, dtype=bool)
    # of random shapes at n sensors, 1 − MAC has a beta distribution
    chance = 1 - scipy.special.betaincinv(0.5 * (n_sensors - 1), 0.5, SHAPE_CHANCE)
    near = np.abs(poles[:, None] - poles) < ONE_SHAPE_REACH * _heavier(poles)
    return np.asarray(near & (sensors > max(ONE_SHAPE, chance)))


def _followers(data: FitData, estimate: Estimate, solution: LinearSolution) -> NDArray[np.bool_]:
    """Pairs of poles that follow one moving frequency, as far as one or two sensors can tell, (n_modes, n_modes)."""
    sensors, n_sensors = _sensors(data, estimate, solution)
    if n_sensors > FEW_SENSORS:
        return np.zeros(sensors.shape, dtype=bool)
    poles = estimate.poles
    heavier = _heavier(poles)
    ratio = heavier**2 / (poles.real[:, None] * poles.real)
    residues = (solution.shapes.conj().T @ solution.shapes) * (
        estimate.participation.conj() @ estimate.participation.T
    )
    return np.asarray(
        (np.abs(poles.imag[:, None] - poles.imag) < FEW_REACH * heavier)
        & (ratio > DECAY_RATIO[0])
        & (ratio < DECAY_RATIO[1])
        & (np.abs(residues.imag) > QUADRATURE * np.abs(residues))
        & (sensors > ONE_SHAPE)
    )


def _heavier(poles: NDArray[np.complex128]) -> Real:
    """The larger decay rate of every pair, (n_modes, n_modes)."""
    return np.maximum(-poles.real[:, None], -poles.real)


def _sensors(data: FitData, estimate: Estimate, solution: LinearSolution) -> tuple[Real, int]:
    """MAC of the modes at the sensors that measured together, (n_modes, n_modes), and the number of these."""
    if data.transposed:
        return mac(estimate.participation, estimate.participation), data.measured.shape[1]
    return mac(solution.shapes.T, solution.shapes.T), data.measured.shape[0]


def _second_singular(estimate: Estimate, solution: LinearSolution, pairs: NDArray[np.bool_]) -> Real:
    """Second over first singular value of the sum of two modes' residues, for the pairs asked for."""
    out = np.ones(pairs.shape)
    for a, b in np.argwhere(np.triu(pairs, 1)):
        left = np.linalg.qr(solution.shapes[:, [a, b]])[1]
        right = np.linalg.qr(estimate.participation[[a, b]].T)[1]
        values = np.linalg.svd(left @ right.T, compute_uv=False)
        out[a, b] = out[b, a] = values[1] / values[0] if len(values) > 1 else 0.0
    return out


def significance(
    data: FitData, noise: Noise, estimate: Estimate, solution: LinearSolution
) -> tuple[Real, Real]:
    """Growth of χ² without each mode, and the growth that noise alone may reach.

    Noise that all outputs share gives them one common chance to look like a mode, not one each; the limit
    is raised by its share at the mode's frequency. Noise under an exponential window decays itself, which
    makes it the more like a mode.
    """
    m = len(estimate.poles)
    if not m:
        return np.zeros(0), np.zeros(0)
    gain = evidence(solution, m)
    rows = int(np.count_nonzero(data.measured.any(axis=1)))
    chance = FALSE_ALARM / len(data.omega)
    free = 2 * rows + 2 * data.measured.shape[1]
    independent = scipy.special.chdtri(free, chance)
    coherent = free / 4 * scipy.special.chdtri(4, chance)
    at = np.clip(np.searchsorted(data.omega, estimate.poles.imag), 0, len(data.omega) - 1)
    weight = noise.weight(data.measured)
    share = np.einsum("oil,oil->l", noise.common, weight)[at] / max(np.count_nonzero(data.measured), 1)
    limit = (1 - share) * independent + share * coherent
    return gain, limit * likeness(-estimate.poles.real, data)
