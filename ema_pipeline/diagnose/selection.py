"""Forward selection: the best supported effect is added, and the remaining hypotheses are tested again with it in the
model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.diagnose.backward import reconsidered
from ema_pipeline.diagnose.claims import BETTER_CONTRADICTED, Judged, judge
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.probability import NOTHING, probabilities
from ema_pipeline.diagnose.ranking import CONTENDERS, Ranked, Ranking, rank, unbeaten
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.inference import Posterior, beyond
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, Model, fit_base, part_reach, within_scatter

Progress = Callable[[float, str], None]

_PARALLEL = 0.95
"""Cosine of what an effect and what a part change from which they are the same place."""
_TIE = 0.1
"""Difference of log evidence within which the order of two effects is that of their names."""


@dataclass(frozen=True)
class Round:
    """One question: what is missing on top of the current model.

    Attributes
    ----------
    ranking : Ranking
    judged : tuple of Judged
        Finalists, best first.
    probabilities : dict of str to float
        Of every hypothesis by the name that is said, and of `NOTHING`; adds up to 1.
    """

    ranking: Ranking
    judged: tuple[Judged, ...]
    probabilities: Mapping[str, float]

    @property
    def best(self) -> Judged | None:
        """The best supported hypothesis that is claimed."""
        return next((j for j in self.judged if j.claimed), None)

    def alike(self, settings: DiagnoseSettings) -> tuple[Judged, ...]:
        """The best claimed hypothesis and all that explain the data as well; the rig's own before generic ones.

        Rivals need not pass the threshold of a claim themselves: what the best one has, they nearly have.
        """
        best = self.best
        if best is None:
            return ()
        near = [j for j in self.judged if j is best or (j.gain > 0 and best.gain - j.gain < settings.alike)]

        def order(j: Judged) -> tuple[bool, float, str]:
            behind = best.gain - j.gain
            return j.hypothesis.generic, behind if behind > _TIE else 0.0, j.hypothesis.label

        return tuple(sorted(near, key=order))


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
    """

    rounds: tuple[Round, ...]
    claimed: tuple[Judged, ...]
    final: Fit
    observations: Observations


def select(
    observations: Observations,
    known: Model,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    progress: Progress = lambda share, text: None,
    first: Sequence[Hypothesis] = (),
    before: Mapping[str, Posterior] | None = None,
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
    first : sequence of Hypothesis
        What is asked about at first, where it is known what leads; all where it is empty.
    before : dict of str to Posterior, optional
        Fits of hypotheses to the same data with fewer unknowns.
    """
    observations = observations.suited(known.effects)
    base = start = fit_base(observations, known)
    rounds: list[Round] = []
    claimed: list[Judged] = []
    rivals: dict[str, tuple[Judged, ...]] = {}
    fitted: dict[str, Posterior] = {}

    def ask(base: Fit, claimed: Sequence[Judged], rounds: Sequence[Round]) -> Round:
        taken = {j.hypothesis.label for j in claimed}
        left = [h for h in hypotheses if h.label not in taken]
        done, part = len(rounds) / (settings.most_effects + 1), 1 / (settings.most_effects + 1)
        ranking = rank(
            observations,
            base,
            left if claimed or not first else first,
            settings.processes,
            lambda share, text: progress(done + share * part, text),
            settings.further_finalists,
            rounds[-1].ranking.unpaired if rounds else 0.0,
            before,
        )
        fitted.update({r.hypothesis.label: r.fit.posterior for r in ranking.ranked})
        asked = _beside(settings, claimed) if observations.linearised else settings
        return _round(observations, ranking, left, asked, len(claimed))

    ahead: Round | None = None
    while True:
        found, ahead = ahead or ask(base, claimed, rounds), None
        leader = _tentative(observations, found, settings)
        if leader is not None and len(claimed) + 1 < settings.most_effects:
            base = fit_base(observations, leader.ranked.fit.model, leader.ranked.fit)
            further = ask(base, [*claimed, leader], [*rounds, found])
            both = _both(observations, found, further, settings)
            if both is not None:
                found, ahead = _acquitted(found, leader, both, hypotheses, settings, len(claimed)), further
        rounds.append(found)
        near = found.alike(settings)
        if not near or len(claimed) == settings.most_effects:
            return Selection(tuple(rounds), tuple(claimed), found.ranking.base, observations)
        added = next(j for j in near if j.claimed)  # a rival alone does not pass the conditions of a claim
        suited = observations.suited(added.ranked.fit.model.effects)
        if suited is not observations:
            leading = [j.hypothesis for j in claimed]
            leading += [r.hypothesis for r in unbeaten(found.ranking.ranked[:CONTENDERS], lambda r: r.gain)]
            return select(suited, known, hypotheses, settings, progress, leading, fitted)
        claimed.append(added)
        rivals[added.hypothesis.label] = found.judged
        if len(claimed) > 1:
            now = reconsidered(observations, start, claimed, rivals, settings)
            ahead = ahead if now == claimed else None
            claimed = now
        if ahead is None:
            base = fit_base(observations, claimed[-1].ranked.fit.model, claimed[-1].ranked.fit)


def _beside(settings: DiagnoseSettings, claimed: Sequence[Judged]) -> DiagnoseSettings:
    """What is asked of a further effect beside those that are claimed."""
    gained = sum(j.gain for j in claimed if not j.hypothesis.placed.effect.linear)
    return settings.model_copy(update={"claim": settings.claim + settings.linearised * gained})


def _tentative(observations: Observations, found: Round, settings: DiagnoseSettings) -> Judged | None:
    """What cannot be claimed alone and may be right beside a second effect; None where there is nothing.

    The fit with one of two missing effects bends parts for the other one. So what leads may predict data held out
    worse, and where the base model fails, what reduces its error most may gain nothing.
    """
    if found.best is not None or not found.judged:
        return None
    if found.judged[0].predicts_worse:
        return found.judged[0]
    least = min(found.judged, key=lambda j: j.after.posterior.error)
    if observations.linearised or least.after.posterior.error >= least.base.posterior.error:
        return None
    base = within_scatter(observations, found.ranking.base)
    return least if base.posterior.error > settings.error_limit else None


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
    leads = leader is found.judged[0]
    acquitted = replace(leader, doubt="", gain=leader.gain if leads else both.gain)
    others = [j for j in found.judged if j is not leader]
    others = [replace(j, doubt="") if j.doubt == BETTER_CONTRADICTED else j for j in others]
    return _weighed(found.ranking, [acquitted, *others], hypotheses, settings, known)


def _round(
    observations: Observations,
    ranking: Ranking,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
) -> Round:
    ranking = _with_relief(observations, ranking, settings)
    nothing = probabilities(ranking, hypotheses, settings, found)[NOTHING]
    finals = [r for r in ranking.ranked if r.final]
    judged = [judge(observations, ranking, r, settings, nothing) for r in finals]
    return _weighed(ranking, sorted(judged, key=lambda j: -j.gain), hypotheses, settings, found)


def _with_relief(observations: Observations, ranking: Ranking, settings: DiagnoseSettings) -> Ranking:
    """The ranking in which a base model that fails once no part stands out has the evidence of that fit.

    Left alone, the scatter of a few parts grows until none stands out, and the evidence of a base model that bends
    one part is hardly behind that of the model with what is missing there. An effect that changes just what a part
    that stands out changes is helped to the difference, if it explains the data with none that does.
    """
    p = ranking.base.posterior
    bounded = within_scatter(observations, ranking.base).posterior
    if bounded is p or bounded.error <= settings.error_limit:
        return ranking
    relief = p.log_evidence + p.scatter_cost - bounded.log_evidence - bounded.scatter_cost
    parts = [p.unknowns.names[i] for i in np.flatnonzero(beyond(p, part_reach(observations, p)))]

    def relieved(one: Ranked) -> Ranked:
        found = within_scatter(observations, one.fit)
        explains = found is one.fit and found.posterior.error <= settings.error_limit
        return replace(one, gain=one.gain + max(relief, 0.0)) if explains and _changes(one, parts) else one

    ranked = [relieved(r) if r.final else r for r in ranking.ranked]
    return replace(ranking, ranked=tuple(sorted(ranked, key=lambda r: -r.gain)))


def _changes(one: Ranked, parts: Sequence[str]) -> bool:
    """True where an effect changes the predictions as one of these parts does."""
    posterior, placed = one.fit.posterior, one.hypothesis.placed
    _, jacobian = posterior.residuals.weighted
    index = posterior.unknowns.index
    by_size = jacobian[:, index[placed.parameter_name(placed.effect.parameters[0].name)]]
    by_part = jacobian[:, [index[name] for name in parts if name in index]]
    size = np.linalg.norm(by_size) * np.linalg.norm(by_part, axis=0)
    return bool(np.any(np.abs(by_size @ by_part) > _PARALLEL * size))


def _weighed(
    ranking: Ranking,
    judged: Sequence[Judged],
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
) -> Round:
    """The round in which nothing is claimed that is far behind what is contradicted."""
    least = _least_believed(judged, settings)
    believed = {j.named.label: j.believed for j in judged}
    told = probabilities(ranking, hypotheses, settings, found, believed, least)
    judged = [replace(j, doubt=BETTER_CONTRADICTED) if j.claimed and j.gain < least else j for j in judged]
    return Round(ranking, tuple(judged), told)


def _least_believed(judged: Sequence[Judged], settings: DiagnoseSettings) -> float:
    """Gain below which none is believed: far below one that error or held-out data contradict.

    What contradicts the better one speaks against its rivals as much, whose probability is a small share of its own.
    """
    return max((j.gain for j in judged if j.contradicted), default=-np.inf) - settings.alike
