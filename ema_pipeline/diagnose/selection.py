"""Forward selection: the best supported effect is added, and the remaining hypotheses are tested again with it in the
model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import is_

import numpy as np

from ema_pipeline.diagnose.backward import alike_beside, cannot_be_told, reconsidered
from ema_pipeline.diagnose.claims import BY_OTHERS, Judged, judge, linearised
from ema_pipeline.diagnose.first_fits import CONTINUED
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.probability import most_doubt
from ema_pipeline.diagnose.ranked import unbeaten
from ema_pipeline.diagnose.ranking import CONTENDERS, rank
from ema_pipeline.diagnose.rounds import Round, round_of, weighed
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, Model, fit_base, refined, transferred, within_scatter

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Selection:
    """All rounds, the last of which found nothing more.

    Attributes
    ----------
    rounds : tuple of Round
    claimed : tuple of Judged
        In the order in which they were added.
    final : Fit
        The model with all that is claimed.
    observations : Observations
        With the unknowns that this model calls for.
    alike : tuple of tuple of Judged
        Per claim: it, and what explains the data as well in its place.
    """

    rounds: tuple[Round, ...]
    claimed: tuple[Judged, ...]
    final: Fit
    observations: Observations
    alike: tuple[tuple[Judged, ...], ...]


@dataclass(frozen=True)
class Earlier:
    """What a selection from the same data with fewer unknowns has shown.

    Attributes
    ----------
    leading : tuple of Hypothesis
        What was claimed, and what came near it in the last round.
    rounds : int
        Rounds in which these led.
    fitted : dict of str to Posterior
        Fits of hypotheses.
    closed : bool
        True where the first of them is asked about alone, then all of them, and nothing else.
    """

    leading: tuple[Hypothesis, ...] = ()
    rounds: int = 0
    fitted: Mapping[str, Posterior] = field(default_factory=dict)
    closed: bool = False


def select(
    observations: Observations,
    known: Model,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    progress: Progress = lambda share, text: None,
    earlier: Earlier = Earlier(),
) -> Selection:
    """Add effects one by one while the data support them, once more with unknowns that what was added calls for.

    Parameters
    ----------
    observations : Observations
    known : Model
        Effects that the model has already.
    hypotheses : sequence of Hypothesis
    settings : DiagnoseSettings
    progress : callable
    earlier : Earlier
        Where it is known what leads, nothing else is asked about, unless that leads nowhere.
    """
    plain, observations = observations, observations.suited(known.effects)
    base = start = _fitted(observations, plain, known)
    observations = observations.about(known.effects, base.posterior)
    rounds: list[Round] = []
    claimed: list[Judged] = []
    of_claims: dict[str, Round] = {}
    fitted: dict[str, Posterior] = {}

    def ask(
        base: Fit,
        claimed: Sequence[Judged],
        rounds: Sequence[Round],
        among: Sequence[Hypothesis] = (),
        before: Mapping[str, Posterior] = earlier.fitted,
    ) -> Round:
        left = [h for h in hypotheses if not _taken(observations, h, claimed)]
        labels = {h.label for h in among}
        done, part = len(rounds) / (settings.most_effects + 1), 1 / (settings.most_effects + 1)
        ranking = rank(
            observations,
            base,
            [h for h in left if h.label in labels] or left,
            settings.processes,
            lambda share, text: progress(done + share * part, text),
            settings.further_finalists,
            rounds[-1].ranking.unpaired if rounds else 0.0,
            before,
            [j.ranked.fit for j in claimed[-1:]],
        )
        fitted.update({r.hypothesis.label: r.fit.posterior for r in ranking.ranked})
        return round_of(observations, ranking, left, _beside(observations, settings, claimed), len(claimed))

    ahead: Round | None = None
    while True:
        alone = 1 if earlier.closed and not claimed else None
        leading = earlier.leading[:alone] if len(claimed) < earlier.rounds and ahead is None else ()
        found, ahead = ahead or ask(base, claimed, rounds, leading), None
        leaders = _tentative(observations, found, settings)
        if leading and not earlier.closed and found.best is None and not leaders:
            found = ask(base, claimed, rounds)
            leaders = _tentative(observations, found, settings)
        for leader in leaders if len(claimed) + 1 < settings.most_effects else ():
            base = fit_base(observations, leader.ranked.fit.model, leader.ranked.fit)
            further = ask(base, [*claimed, leader], [*rounds, found])
            both = _both(observations, found, further, settings)
            if both is not None:
                found, ahead = _acquitted(found, leader, both, hypotheses, settings, len(claimed)), further
                break
        near = found.alike(settings)
        if ahead and ahead.best and not near:
            # what led carries no claim, and led to an effect that may carry one alone: asked from where it was found
            led_to = {ahead.best.hypothesis.label: ahead.best.ranked.fit.posterior}
            found, ahead = ask(found.ranking.base, claimed, rounds, before=led_to), None
            near = found.alike(settings)
        rounds.append(found)
        if not near or len(claimed) == settings.most_effects:
            final = found.ranking.base
            groups = alike_beside(observations, known, claimed, of_claims, final, settings)
            return Selection(tuple(rounds), tuple(claimed), final, observations, groups)
        added = next(j for j in near if j.claimed)  # a rival alone does not pass the conditions of a claim
        suited = observations.suited(added.ranked.fit.model.effects)
        if suited is not observations:
            led = [j.hypothesis for j in claimed]
            led += [r.hypothesis for r in unbeaten(found.ranking.ranked[:CONTENDERS], lambda r: r.gain)]
            known_so_far = Earlier(tuple(led), len(claimed) + 1, fitted)
            return select(suited, known, hypotheses, settings, progress, known_so_far)
        claimed.append(added)
        of_claims[added.hypothesis.label] = found
        if len(claimed) > 1:
            now = reconsidered(observations, start, claimed, of_claims, settings)
            ahead = ahead if len(now) == len(claimed) and all(map(is_, now, claimed)) else None
            claimed = now
        if ahead is None:
            base = fit_base(observations, claimed[-1].ranked.fit.model, claimed[-1].ranked.fit)


def _fitted(observations: Observations, plain: Observations, known: Model) -> Fit:
    """Fit of the known model: begun anew, or from that to `plain` data, with fewer unknowns, where this leads further.

    With a damping ratio of its own for every mode, all modes of a gearbox but one lost their partners.
    """
    anew = fit_base(observations, known)
    if observations is plain:
        return anew
    unknowns = known.problem(observations).unknowns
    start = transferred(fit_base(plain, known).posterior, unknowns)
    continued = refined(observations, known, start, steps=CONTINUED)
    return max(anew, continued, key=lambda fit: fit.log_evidence)


def _taken(observations: Observations, hypothesis: Hypothesis, claimed: Sequence[Judged]) -> bool:
    """True for what is claimed already, and for what could not be told from what linearisation leaves of it."""
    others = [j.hypothesis for j in claimed]
    return any(
        other.label == hypothesis.label or cannot_be_told(observations, hypothesis, other) for other in others
    )


def _beside(
    observations: Observations, settings: DiagnoseSettings, claimed: Sequence[Judged]
) -> DiagnoseSettings:
    """What is asked of a further effect beside those that are claimed."""
    gains = [j.gain for j in claimed if linearised(observations, j.hypothesis)]
    left = settings.linearised * sum(gains) + (settings.linearised_claim if gains else 0.0)
    doubt = most_doubt(settings, len(claimed))
    return settings.model_copy(update={"claim": settings.claim + left, "doubt": doubt})


def _tentative(observations: Observations, found: Round, settings: DiagnoseSettings) -> tuple[Judged, ...]:
    """What cannot be claimed alone and may be right beside a second effect, what leads first.

    The fit with one of two missing effects bends parts for the other one. So error or held-out data may contradict what
    leads, and where the base model fails, what reduces its error most may gain nothing.
    """
    if found.best is not None or not found.judged:
        return ()
    leads, least = found.judged[0], min(found.judged, key=lambda j: j.after.posterior.error)
    leading = (leads,) if leads.contradicted else ()
    reduces = least.after.posterior.error < least.base.posterior.error
    if observations.linearised or not reduces or (least is leads and leading):
        return leading
    base = within_scatter(observations, found.ranking.base)
    return (*leading, least) if base.posterior.fails(settings.error_limit) else leading


def _both(
    observations: Observations, found: Round, further: Round, settings: DiagnoseSettings
) -> Judged | None:
    """The tentative effect and the best one on top of it, judged together; None where that supports no claim.

    The second is asked all that a claim is asked, on top of the first; and both together are asked the same on top of
    the model without either.
    """
    second = further.best
    if second is None:
        return None
    gain = second.ranked.fit.log_evidence - found.ranking.base.log_evidence
    both = judge(observations, found.ranking, replace(second.ranked, gain=gain), settings)
    return both if both.claimed else None


def _acquitted(
    found: Round,
    leader: Judged,
    both: Judged,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    known: int,
) -> Round:
    """The round with `leader` claimed, and nothing held against others for its sake.

    Where others gained more alone, it counts with what both gain.
    """
    gain = leader.gain if leader is found.judged[0] else both.gain
    ranked = tuple(
        replace(r, gain=gain) if r.hypothesis.label == leader.hypothesis.label else r
        for r in found.ranking.ranked
    )
    acquitted = replace(leader, doubt="", gain=gain, left=np.inf)
    others = [j for j in found.judged if j is not leader]
    others = [replace(j, doubt="") if j.doubt in BY_OTHERS else j for j in others]
    ranking = replace(found.ranking, ranked=ranked)
    return weighed(ranking, [acquitted, *others], hypotheses, settings, known)
