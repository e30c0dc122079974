"""When an effect is claimed: evidence, size, error and held-out data must all support it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.diagnose.heldout import NOTHING_HELD_OUT, HeldOut, held_out_of_each
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.naming import Named, named, sizes_of
from ema_pipeline.diagnose.ranked import BEATEN, Ranked, Ranking
from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.effects.out_of_tolerance import ID as OUT_OF_TOLERANCE
from ema_pipeline.inference import tails
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, at_scatters, averaged, within_scatter
from ema_pipeline.observations.hit_residuals import AMPLITUDE

HELD_OUT_TIE, HELD_OUT_SHARE, LINEARISED_SHARE = 1.0, 0.05, 0.1
"""Log density of data held out by which a claim may be behind, and that share of its gain: few modes predict no better
with a small effect than without, and modes that have no partner without the effect, of which most of a large gain may
come, are never held out. What equivalent linearisation leaves out makes the share larger."""

NO_LESS_ERROR = "adding it does not reduce the error"
PREDICTED_WORSE = "held-out data are predicted worse when it is added"
MAY_BE_ZERO = "its size is within"
BETTER_CONTRADICTED = "an effect that explains the data better is contradicted by held-out data"
BETTER_DOUBTED = "a similar effect that gains more evidence cannot be claimed"
FAR_BEHIND = "another effect that can be claimed explains the data far better"
BY_OTHERS = (BETTER_CONTRADICTED, BETTER_DOUBTED)
"""What is held against an effect for the sake of others alone."""


@dataclass(frozen=True)
class Judged:
    """One hypothesis and what supports it.

    Attributes
    ----------
    ranked : Ranked
    named : Named
    gain : float
        Log evidence gained, under the name that is said.
    base, after : Fit
        The model without and with it, at the same scatters, no part further out than parts scatter.
    held_before, held_after : HeldOut
        Of data held out, without and with it.
    doubt : str
        Why it is not claimed; empty where it is.
    needed : float
        Log evidence that a claim needs.
    left : float
        What is left of `gain` without that which rests on close modes, see `left_of_close_modes`; infinite where it was
        not asked for.
    linearisation : float
        Log evidence that does not count, since what equivalent linearisation leaves out may gain as much.
    """

    ranked: Ranked
    named: Named
    gain: float
    base: Fit
    after: Fit
    held_before: HeldOut
    held_after: HeldOut
    doubt: str
    needed: float
    left: float = np.inf
    linearisation: float = 0.0

    @property
    def hypothesis(self) -> Hypothesis:
        """What was fitted."""
        return self.ranked.hypothesis

    @property
    def specific(self) -> bool:
        """True where the name that is said is one of the rig's own effects, and more than a part out of tolerance."""
        effect = self.named.name.placed.effect
        return not effect.generic and effect.id != OUT_OF_TOLERANCE

    @property
    def claimed(self) -> bool:
        """True where everything supports it."""
        return not self.doubt

    @property
    def contradicted(self) -> bool:
        """True where error or held-out data speak against what the evidence supports."""
        return self.doubt in (NO_LESS_ERROR, PREDICTED_WORSE)

    @property
    def may_be_zero(self) -> bool:
        """True where it gains evidence with a size that may as well be zero: that is no gain of the effect's.

        The base model was stuck, or its close modes were compared otherwise.
        """
        return self.doubt.startswith(MAY_BE_ZERO)

    @property
    def believed(self) -> float:
        """Log evidence that counts for its probability."""
        counted = min(self.gain, self.left) - self.linearisation
        return min(counted, 0.0) if self.contradicted or self.may_be_zero else counted


def judge(
    observations: Observations,
    ranking: Ranking,
    ranked: Ranked,
    settings: DiagnoseSettings,
    nothing: float = 0.0,
    better: Sequence[Judged] = (),
) -> Judged:
    """Hold one finalist against all conditions of a claim.

    Parameters
    ----------
    observations : Observations
    ranking : Ranking
    ranked : Ranked
    settings : DiagnoseSettings
    nothing : float
        Probability that nothing is missing.
    better : sequence of Judged
        What was judged before it. Far behind one that is claimed nothing is held out for it.
    """
    name = named(ranked.hypothesis, ranked.fit)
    gain = ranked.gain + name.advantage
    base = at_scatters(observations, ranking.base, ranked.fit.posterior.scatters)
    base, mended = within_scatter(observations, base), within_scatter(observations, ranked.fit)
    before, after, left = NOTHING_HELD_OUT, NOTHING_HELD_OUT, np.inf
    linearisation = doubtful_evidence(observations, ranked.hypothesis, settings)
    needed = settings.claim + evidence_beyond(observations, ranked.hypothesis, settings)
    beaten = any(j.claimed and gain < j.gain - BEATEN for j in better)
    doubt = FAR_BEHIND if beaten else _weak(observations, ranked, gain, needed, settings, nothing)
    if not doubt:
        asked = observations.holding_out_explained(base.posterior.residuals)
        before, after = held_out_of_each(asked, [base, mended], settings.processes)
        left = left_of_close_modes(base, mended)
        share = LINEARISED_SHARE if linearised(observations, ranked.hypothesis) else HELD_OUT_SHARE
        tie = HELD_OUT_TIE + share * max(min(gain, left), 0.0)
        doubt = _contradicted(base, mended, before, after, tie)
        if not doubt and left < needed:
            doubt = f"{drops_to(left)}, below {needed:g}"
        name = replace(name, sizes=sizes_of(ranked.hypothesis, name.name, averaged(observations, mended)))
    return Judged(ranked, name, gain, base, mended, before, after, doubt, needed, left, linearisation)


def _weak(
    observations: Observations,
    ranked: Ranked,
    gain: float,
    needed: float,
    settings: DiagnoseSettings,
    nothing: float,
) -> str:
    if gain < needed:
        return f"its gain in log evidence, {gain:.1f}, is below {needed:g}"
    if doubt := doubt_of_nothing(nothing, settings):
        return doubt
    if not ranked.hypothesis.size_cannot_be_zero:
        p = ranked.hypothesis.placed.effect.parameters[0]
        i = ranked.fit.posterior.unknowns.index[ranked.hypothesis.placed.parameter_name(p.name)]
        x, std = ranked.fit.posterior.x[i], _std_of_first(ranked)
        sigmas = sigmas_asked(observations, ranked.hypothesis, settings)
        if abs(x) < sigmas * std:
            return f"{MAY_BE_ZERO} {sigmas:g} standard deviations of zero"
    return ""


def drops_to(left: float) -> str:
    """What is left of a gain without what some effect or other explains wherever modes lie close together."""
    return (
        "without what tests often make of closely spaced modes (a wrong shape, one mode found twice, or two found as "
        f"one) its gain in log evidence drops to {left:.1f}"
    )


def doubt_of_nothing(nothing: float, settings: DiagnoseSettings) -> str:
    """Why nothing is claimed at a probability that nothing of the library is missing; empty where something may be."""
    if nothing <= settings.doubt:
        return ""
    told, most = (probability_text(p) for p in (nothing, settings.doubt))
    return f"the probability that no effect of the library is missing, {told}, is above {most}"


def sigmas_asked(observations: Observations, hypothesis: Hypothesis, settings: DiagnoseSettings) -> float:
    """Distance from nothing that a claim asks of a size, in its standard deviations."""
    return settings.linearised_sigmas if linearised(observations, hypothesis) else settings.sigmas


def doubtful_evidence(
    of: Observations | Ranking, hypothesis: Hypothesis, settings: DiagnoseSettings
) -> float:
    """Log evidence that an effect may gain from what equivalent linearisation leaves out."""
    return settings.linearised_claim if linearised(of, hypothesis) else 0.0


def evidence_beyond(observations: Observations, hypothesis: Hypothesis, settings: DiagnoseSettings) -> float:
    """Log evidence that a claim needs in addition for the sake of it.

    Twice as much of a generic effect: of springs between any two bodies some fit what is left. It is no less probable
    for that than the rig's own effect with the same signs.
    """
    return (2 if hypothesis.generic else 1) * doubtful_evidence(observations, hypothesis, settings)


def linearised(of: Observations | Ranking, hypothesis: Hypothesis) -> bool:
    """True where equivalent linearisation alone tells what the effect does."""
    return not hypothesis.placed.effect.linear and of.linearised


def _std_of_first(ranked: Ranked) -> float:
    """1 σ of the first size, its other sizes and the scale of all amplitudes held.

    A size and a shape that only show together are no doubt of either, and no scale of amplitudes takes a size to zero.
    """
    posterior, placed = ranked.fit.posterior, ranked.hypothesis.placed
    index = posterior.unknowns.index
    at = [index[placed.parameter_name(p.name)] for p in placed.effect.parameters]
    at += [index[AMPLITUDE]] if AMPLITUDE in index else []
    own = posterior.covariance[np.ix_(at, at)]
    return float(1 / np.sqrt(max(np.linalg.pinv(own)[0, 0], 1e-300)))


def _contradicted(base: Fit, mended: Fit, before: HeldOut, after: HeldOut, tie: float) -> str:
    if mended.posterior.error >= base.posterior.error:
        return NO_LESS_ERROR
    if after.log_density < before.log_density - tie:
        return PREDICTED_WORSE
    return ""


def left_of_close_modes(base: Fit, mended: Fit) -> float:
    """Gain in log evidence without what some effect or other explains wherever modes lie close together.

    The shape of one of them may be identified wrongly, one may be split off another by drift, and a mode that the
    effect adds may be said to hide in one whose shape fits none.
    """
    # at the same scatters, whose cost is no difference
    evidence = [fit.posterior.evidence_at_scatters for fit in (base, mended)]
    before, after = (fit.posterior.residuals for fit in (base, mended))
    left = evidence[1] - evidence[0] - max(before.split - after.split, 0.0)
    of_before, of_after = before.mode_of_block, after.mode_of_block
    if before.mode is None and len(of_before) != len(of_after):  # which modes have partners is not known
        return left
    _, at, to = np.intersect1d(of_before, of_after, return_indices=True)  # have a partner with and without it
    costs = tails.cost(*before.blocks)[at], tails.cost(*after.blocks)[to]
    usual = tails.cost(after.blocks[1], after.blocks[1])[to]
    hides = after.blurred_blocks[to] & ~before.blurred_blocks[at]
    left -= float(np.sum(np.maximum(costs[0] - np.maximum(costs[1], usual), 0.0)[hides]))
    mixed = before.mixed_blocks[at] & ~hides
    return left - float(np.max((costs[0] - costs[1])[mixed], initial=0.0))
