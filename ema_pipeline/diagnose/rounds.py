"""One round of the selection: what is missing on top of the current model, judged and weighed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.diagnose.claims import (
    BETTER_CONTRADICTED,
    BETTER_DOUBTED,
    Judged,
    doubt_of_nothing,
    doubtful_evidence,
    drops_to,
    judge,
)
from ema_pipeline.diagnose.explained import (
    MOST_GAINED,
    fails_at_usual_scatters,
    outlying_damping,
    with_usual_scatters,
)
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.naming import named
from ema_pipeline.diagnose.probability import divided_as, probabilities
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING
from ema_pipeline.inference import beyond
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, learned, part_reach, within_scatter

_PARALLEL = 0.95
"""Cosine of what an effect and what a part change from which they are the same place."""
_TIE = 0.1
"""Difference of log evidence within which the order of two effects is that of their names."""
_ROUGH = 10.0
"""The same within which friction may be at either of two places: its evidence jumps so far from force to force."""
_SECOND = 2 * _TIE
"""By how much what is as good as the best stays behind it: what is added first is what the evidence prefers."""


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
        """The best claimed hypothesis and all that explain the data as well; the rig's own effects first.

        A part out of tolerance is no more likely than a generic effect that explains the data better. Rivals need not
        pass the threshold of a claim themselves: what the best one has, they nearly have. Those whose size may be zero
        explain nothing.
        """
        best = self.best
        if best is None:
            return ()
        near = [
            j
            for j in self.judged
            if j is best or (j.gain > 0 and best.gain - j.gain < settings.alike and not j.may_be_zero)
        ]

        def order(j: Judged) -> tuple[bool, float, str]:
            behind = best.gain - j.gain
            return not j.specific, behind if behind > _TIE else 0.0, j.hypothesis.label

        return tuple(sorted(near, key=order))


def round_of(
    observations: Observations,
    ranking: Ranking,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
) -> Round:
    """Judge the finalists of a ranking, beside `found` effects."""
    ranking = _with_relief(observations, ranking, settings)
    ranking = _at_usual_scatters(observations, ranking, settings)
    nothing = probabilities(ranking, hypotheses, settings, found)[NOTHING]
    judged: list[Judged] = []
    for one in sorted((r for r in ranking.ranked if r.final), key=lambda r: -r.gain):
        judged.append(judge(observations, ranking, one, settings, nothing, judged))
    best = max((j for j in judged if j.claimed), key=lambda j: j.gain, default=None)
    if best is not None:
        judged = [replace(j, gain=_levelled(observations, j, best)) for j in judged]
    return weighed(ranking, sorted(judged, key=lambda j: -j.gain), hypotheses, settings, found)


def _levelled(observations: Observations, one: Judged, best: Judged) -> float:
    """Its gain; nearly that of the best where this leads by no more than what equivalent linearisation leaves out of
    both, and predicts held-out data worse, or where both are known to first order only, as friction.
    """
    lead, both = best.gain - one.gain, (one, best)
    if one is best or not one.claimed or lead >= min(one.linearisation, best.linearisation):
        return one.gain
    rough = all(observations.in_full([j.hypothesis.placed], j.after.posterior) for j in both)
    better = one.held_after.log_density > best.held_after.log_density
    return best.gain - _SECOND if better or (rough and lead < _ROUGH) else one.gain


def _with_relief(observations: Observations, ranking: Ranking, settings: DiagnoseSettings) -> Ranking:
    """The ranking in which a base model that fails once no part stands out, or loses much evidence with them, has the
    evidence of that fit.

    Left alone, the scatter of a few parts grows until none stands out, and the evidence of a base model that bends
    one part is hardly behind that of the model with what is missing there. Where an effect that changes just what a
    part that stands out changes explains the data with none that does, everything that explains them so is helped to
    the difference.
    """
    p, bounded = ranking.base.posterior, within_scatter(observations, ranking.base)
    relief = _lost(ranking.base, bounded)
    if bounded is ranking.base or not (bounded.posterior.fails(settings.error_limit) or relief > MOST_GAINED):
        return ranking
    parts = [p.unknowns.names[i] for i in np.flatnonzero(beyond(p, part_reach(observations, p)))]

    def helped(one: Ranked) -> Ranked | None:
        """With none that stands out, if it explains the data so; None where it does not."""
        if not one.final:
            return None
        fit = within_scatter(observations, one.fit)
        if fit is not one.fit:  # its own scatters were learned with that part
            fit = learned(observations, fit, past_barriers=False)
            if within_scatter(observations, fit) is not fit:
                return None
        if fit.posterior.fails(settings.error_limit):
            return None
        gain = one.gain + fit.log_evidence - one.fit.log_evidence
        return replace(one, fit=fit, gain=gain + max(relief, 0.0))

    better = {r.hypothesis.label: able for r in ranking.ranked if (able := helped(r))}
    if not any(_changes(able, parts) for able in better.values()):
        return ranking
    ranked = [better.get(r.hypothesis.label, r) for r in ranking.ranked]
    return replace(ranking, ranked=tuple(sorted(ranked, key=lambda r: -r.gain)))


def _at_usual_scatters(observations: Observations, ranking: Ranking, settings: DiagnoseSettings) -> Ranking:
    """The ranking at usual scatters of frequencies, shapes and damping ratios where those of the base model are larger,
    and it fails with the usual ones.

    Left alone, they grow until they hold what is missing about as well as it can be held. What explains the data with
    the usual ones is helped to the difference.
    """
    if not fails_at_usual_scatters(observations, ranking.base, settings):
        return ranking
    lost_by_base = _lost(ranking.base, with_usual_scatters(observations, ranking.base))

    def relieved(one: Ranked) -> Ranked:
        if not one.final:
            return one
        held = with_usual_scatters(observations, one.fit)
        fails = within_scatter(observations, held).posterior.fails(settings.error_limit)
        if fails or outlying_damping(observations, held) is not None:
            return one
        return replace(one, gain=one.gain + max(lost_by_base - _lost(one.fit, held), 0.0))

    ranked = sorted(map(relieved, ranking.ranked), key=lambda r: -r.gain)
    return replace(ranking, ranked=tuple(ranked))


def _lost(fit: Fit, held: Fit) -> float:
    """Log evidence that a fit loses where something is held, whatever that costs."""
    return fit.posterior.evidence_at_scatters - held.posterior.evidence_at_scatters


def _changes(one: Ranked, parts: Sequence[str]) -> bool:
    """True where an effect changes the predictions as one of these parts does."""
    posterior, placed = one.fit.posterior, one.hypothesis.placed
    _, jacobian = posterior.residuals.weighted
    index = posterior.unknowns.index
    by_size = jacobian[:, index[placed.parameter_name(placed.effect.parameters[0].name)]]
    by_part = jacobian[:, [index[name] for name in parts if name in index]]
    size = np.linalg.norm(by_size) * np.linalg.norm(by_part, axis=0)
    return bool(np.any(np.abs(by_size @ by_part) > _PARALLEL * size))


def weighed(
    ranking: Ranking,
    judged: Sequence[Judged],
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
) -> Round:
    """The round in which nothing is claimed that others speak against, or that may as well be nothing.

    Of the evidence only what is believed counts: verdict and probabilities agree. What rests on close modes is a doubt
    whether anything is missing; among rivals it is evidence like any other for one that is claimed all the same.
    """
    # What contradicts one speaks against rivals far behind it as much: their probability is a small share of its own.
    least = max((j.gain for j in judged if j.contradicted), default=-np.inf) - settings.alike
    believed = _without_linearisation(ranking, settings) | {j.named.label: j.believed for j in judged}
    told = probabilities(ranking, hypotheses, settings, found, believed, least)
    nothing = doubt_of_nothing(told[NOTHING], settings)
    doubts = [_against(j, judged, least, nothing) if j.claimed else "" for j in judged]
    judged = [replace(j, doubt=doubt) if doubt else j for j, doubt in zip(judged, doubts, strict=True)]
    among = believed | {j.named.label: j.gain - j.linearisation for j in judged if j.claimed}
    rivals = probabilities(ranking, hypotheses, settings, found, among, least)
    return Round(ranking, tuple(judged), divided_as(rivals, told))


def _against(one: Judged, judged: Sequence[Judged], least: float, nothing: str = "") -> str:
    """Why something is not claimed: far behind what is contradicted, one of many, or `nothing` is too probable."""
    if one.gain < least:
        return BETTER_CONTRADICTED
    if _one_of_many(one, judged):
        return BETTER_DOUBTED
    return f"{nothing}, and {drops_to(one.left)}" if nothing and one.left < one.gain else nothing


def _one_of_many(one: Judged, judged: Sequence[Judged]) -> bool:
    """True where equivalent linearisation alone tells what an effect does, and such effects that gain more are doubted.

    Among springs anywhere that fit what is left about as well, one or the other passes by chance.
    """
    if not one.linearisation:
        return False
    better = (j for j in judged if j.linearisation and j.gain > max(one.gain, j.needed))
    return any(not j.claimed for j in better)


def _without_linearisation(ranking: Ranking, settings: DiagnoseSettings) -> dict[str, float]:
    """What counts of all gains where equivalent linearisation alone tells what some effects do, by the name said."""
    ranked = ranking.ranked if ranking.linearised else ()
    names = [named(r.hypothesis, r.fit) for r in ranked]
    return {
        n.label: r.gain + n.advantage - doubtful_evidence(ranking, r.hypothesis, settings)
        for r, n in zip(ranked, names, strict=True)
    }
