"""Whether a model explains the data, and what speaks against it where it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ema_pipeline.diagnose.settings import MOST_UNEXPLAINED, DiagnoseSettings
from ema_pipeline.inference import Posterior, beyond
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import PARTS, Fit, at_scatters, part_reach, within_scatter
from ema_pipeline.observations.hit_residuals import LINEARISATION
from ema_pipeline.observations.mode_problem import MIXING
from ema_pipeline.observations.mode_rows import FREQUENCY, FREQUENCY_NOISE, SHAPE
from ema_pipeline.observations.parts import DAMPING_SCATTER, JOINT_DAMPING

_OF_TESTS = (FREQUENCY, FREQUENCY_NOISE, SHAPE)
"""Scatters of what tests and models have wrong, and no parts. In 118 simulated tests of rigs without fault none was
more than a fifteenth above its default, which is what is usual; what was not in the library and was missed had brought
them to twice their defaults. Those of parts differ from rig to rig: masses of a right model scattered by 4 %."""
MOST_GAINED, MOST_WITH_MIXING = 15.0, 25.0
"""Log evidence that larger ones may gain, and parts further out than parts scatter; and that with a larger mixing of
close shapes. Of rigs without fault one gained 20, by mixing, and no other more than 7; effects that the library lacked
gained 40 to 150 where the error without all that was 1.0 to 1.35: frequencies hardly count among entries of shapes."""
_USUAL_DAMPING_SCATTER = 0.5
"""1 σ of ln ζ from mode to mode in normal laboratories, where nothing but joints, cables and the suspension damps."""
_BY_CHANCE = 0.005
"""Probability by which damping ratios may scatter as they do and no damper be missing."""
_OF_SCATTER = 0.5
"""Share of its variance from which a damping ratio tells of their scatter, and not of the test."""
_LINEARISED = 0.1
"""1 σ that equivalent linearisation leaves open of a damping ratio, over that of all else, from which it tells of
neither: friction is found with a half of its force, and what it damps then seems damped by something else."""


@dataclass(frozen=True)
class OutlyingDamping:
    """Damping ratios that scatter more than those of structures that lack no damper.

    Attributes
    ----------
    scatter, usual : float
        1 σ of ln ζ about the model's, and the largest of such structures.
    """

    scatter: float
    usual: float


@dataclass(frozen=True)
class OutlyingPart:
    """A part that deviates further from similar ones than these do.

    Attributes
    ----------
    name : str
    deviation, others : float
        Its relative deviation, and the 1 σ by which the others scatter.
    """

    name: str
    deviation: float
    others: float


@dataclass(frozen=True)
class Explanation:
    """How a model explains the data.

    Attributes
    ----------
    telling : (float, int)
        Its error with scatters no larger than usual and no part further out than parts scatter, and of how many data;
        see `Posterior.telling`.
    fails : bool
        True where that is too large, or much evidence rests on scatters that are larger than usual and parts that are
        further out.
    by_modes : float
        Where its error is too large as it was fitted, that of the modes alone, which many data of single hits may hide;
        0 elsewhere.
    by_scatter : float
        Where only a scatter that is larger than usual explains the data, the error at the usual one; 0 elsewhere.
    unpaired : bool
        True where more than one measured mode has no partner.
    stands_still : bool
        True where modes are seen to move with the force, and nothing in the model moves them. Few modes that move weigh
        little in the error of all.
    damping : OutlyingDamping, optional
    parts : tuple of OutlyingPart
        Furthest first. They speak against a model by the error that it has without them.
    """

    telling: tuple[float, int]
    fails: bool
    by_modes: float
    by_scatter: float
    unpaired: bool
    stands_still: bool
    damping: OutlyingDamping | None
    parts: tuple[OutlyingPart, ...]

    @property
    def explained(self) -> bool:
        """True where nothing speaks against the model."""
        return not (self.fails or self.unpaired or self.stands_still or self.damping)


def explanation(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> Explanation:
    """Hold a fitted model against the data."""
    p, limit = fit.posterior, settings.error_limit
    usual = at_usual_scatters(observations, fit)
    narrow = at_usual_scatters(observations, usual, (MIXING,))
    judged = within_scatter(observations, usual).posterior
    held = judged if narrow is usual else within_scatter(observations, narrow).posterior
    gained = p.evidence_at_scatters - judged.evidence_at_scatters
    with_mixing = p.evidence_at_scatters - held.evidence_at_scatters
    fails = gained > MOST_GAINED or with_mixing > MOST_WITH_MIXING or judged.fails(limit)
    by_scatter = 0.0
    if fails and narrow is not fit and not within_scatter(observations, fit).posterior.fails(limit):
        by_scatter = held.error
    return Explanation(
        telling=judged.telling,
        fails=fails,
        by_modes=p.error_apart if p.fails(limit) else 0.0,
        by_scatter=by_scatter,
        unpaired=judged.residuals.unexplained > MOST_UNEXPLAINED,
        stands_still=stands_still(observations, fit),
        damping=outlying_damping(observations, fit),
        parts=outlying_parts(observations, fit),
    )


def stands_still(observations: Observations, fit: Fit) -> bool:
    """True where modes are seen to move with the force, and nothing in the model moves them."""
    return observations.level_dependent and all(e.effect.linear for e in fit.model.effects)


def at_usual_scatters(observations: Observations, fit: Fit, of: Sequence[str] = _OF_TESTS) -> Fit:
    """The fit with frequencies and shapes no further from the model's than usual; the same where they are not.

    Scatters that are learned, those `of` these names, take up what a model lacks.
    """
    usual = {n: _usual_scatter(observations, n) for n in of if n in observations.scatters}
    learned = fit.posterior.scatters
    capped = {n: min(value, usual.get(n, value)) for n, value in learned.items()}
    return fit if capped == learned else at_scatters(observations, fit, capped)


def with_usual_scatters(observations: Observations, fit: Fit) -> Fit:
    """The fit with neither frequencies, shapes nor damping ratios further from the model's than usual."""
    return at_usual_scatters(observations, fit, (*_OF_TESTS, DAMPING_SCATTER, JOINT_DAMPING))


def fails_at_usual_scatters(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> bool:
    """True where frequencies, shapes or damping ratios scatter more than usual, and the fit fails if they must not."""
    usual = at_usual_scatters(observations, fit)
    fails = usual is not fit and within_scatter(observations, usual).posterior.fails(settings.error_limit)
    return fails or outlying_damping(observations, fit) is not None


def outlying_damping(observations: Observations, fit: Fit) -> OutlyingDamping | None:
    """Damping ratios that scatter about the model's more than those of structures that lack no damper.

    Damping follows no law, so its scatter is learned. That alone would hide a damper which the library lacks: of seven
    such dampers in simulated tests, six were taken for scatter.
    """
    if DAMPING_SCATTER not in observations.scatters:
        return None
    p = fit.posterior
    usual = _usual_scatter(observations, DAMPING_SCATTER)
    squares = np.concatenate((_squares_of_ratios(p, usual), _squares_of_own_damping(p, usual)))
    count, total = len(squares), float(np.sum(squares))
    if not count or scipy.special.chdtrc(count, total) > _BY_CHANCE:
        return None
    return OutlyingDamping(usual * float(np.sqrt(total / count)), usual)


def _usual_scatter(observations: Observations, name: str) -> float:
    """The largest value of a scatter that is usual."""
    default = observations.scatters[name].default
    return max(default, _USUAL_DAMPING_SCATTER) if name in (DAMPING_SCATTER, JOINT_DAMPING) else default


def _squares_of_ratios(p: Posterior, usual: float) -> NDArray[np.float64]:
    """Squares of damping ratios that tell of their scatter, over their variances at the usual one."""
    share = p.residuals.share.get(DAMPING_SCATTER)
    if share is None:  # a scatter that is stated to be none has no share
        return np.zeros(0)
    by_linearisation = p.residuals.jacobian * np.where(p.unknowns.governed(LINEARISATION), p.prior_std, 0.0)
    on = (share > _OF_SCATTER) & (np.linalg.norm(by_linearisation, axis=1) < _LINEARISED)
    variance = 1 - share[on] + share[on] * (usual / p.scatters[DAMPING_SCATTER]) ** 2
    return np.asarray(p.residuals.values[on] ** 2 / variance)


def _squares_of_own_damping(p: Posterior, usual: float) -> NDArray[np.float64]:
    """The same of modes and joints whose damping is an unknown of its own."""
    own = np.flatnonzero(p.unknowns.governed(DAMPING_SCATTER) | p.unknowns.governed(JOINT_DAMPING))
    if not len(own):
        return np.zeros(0)
    told = 1 - (p.std[own] / p.prior_std[own]) ** 2  # the share of it that the data tell
    own, told = own[told > _OF_SCATTER], told[told > _OF_SCATTER]
    variance = told * (p.std[own] ** 2 + told * usual**2)
    return np.asarray(p.x[own] ** 2 / variance)


def outlying_parts(observations: Observations, fit: Fit) -> tuple[OutlyingPart, ...]:
    """Every part, and every joint's damping, that lies further out than its like scatter, furthest first."""
    p = fit.posterior
    kinds = (*PARTS, JOINT_DAMPING)
    one_sigma, most = part_reach(observations, p, 1.0, kinds), part_reach(observations, p, kinds=kinds)
    names = [p.unknowns.names[i] for i in np.flatnonzero(beyond(p, most))]
    found = [OutlyingPart(n, float(np.expm1(p.value(n))), one_sigma[n]) for n in names]
    return tuple(sorted(found, key=lambda part: -abs(part.deviation) / part.others))
