"""From the base model upwards: rank all hypotheses, add the one that is claimed, and rank again on top of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ema_pipeline.diagnose.fitting import Case, Fitted, fit_null, holds, refit
from ema_pipeline.diagnose.heldout import held_out
from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, extras, single_hypotheses
from ema_pipeline.diagnose.ladder import noise_of, yardstick
from ema_pipeline.diagnose.noise import NoiseLevel, floors
from ema_pipeline.diagnose.progress import Progress, part
from ema_pipeline.diagnose.ranking import Ranking, rank, sharpen
from ema_pipeline.diagnose.thresholds import threshold
from ema_pipeline.diagnose.witness import Witness
from ema_pipeline.fit.settings import FitSettings

_NEAR_BOUND = 1.02
NOT_SUPPORTED = "no further effect is supported by the data"


@dataclass(frozen=True)
class Climb:
    """Models of the ladder and the rankings on top of each.

    Attributes
    ----------
    models : list of Fitted
        The base model first.
    rankings : list of Ranking
    level : NoiseLevel
    note : str
        Why climbing stopped.
    refuted : bool
        True where held-out data or FRFs spoke against what the modes asked for next.
    """

    models: list[Fitted]
    rankings: list[Ranking]
    level: NoiseLevel
    note: str
    refuted: bool = False

    @property
    def explaining(self) -> list[Fitted]:
        """The models, and hypotheses that may explain modes which these do not: none where the best was refuted."""
        return [*self.models, *([] if self.refuted else self.rankings[0].worthwhile())]

    @property
    def top(self) -> Fitted:
        """The model at the top of the ladder."""
        return self.models[-1]


def first_ranking(case: Case, tell: Progress) -> tuple[Ranking, NoiseLevel]:
    """All hypotheses on the base model, at the noise level that the best of them leaves."""
    settings = case.settings
    tell(0.0, "base model")
    base = fit_null(case, Hypothesis(), settings.fit, None)
    hypotheses = single_hypotheses(case.rig, list(case.measured), case.library)
    if holds(base):
        # The base model itself tells the noise level; one round is enough unless a hypothesis leaves less.
        level = noise_of(case, base)
        base = fit_null(case, Hypothesis(), level.applied(settings.fit), base.values)
        ranking = rank(case, base, hypotheses, level.applied(settings.fit), part(tell, 0.05, 0.8))
    else:
        level = floors(settings.fit)
        ranking = rank(case, base, hypotheses, settings.fit, part(tell, 0.05, 0.8))
    best = min((ranking.base, *ranking.fitted), key=lambda f: f.evidence)
    finer = noise_of(case, best)
    if finer.below(level):
        level = finer
        fit = level.applied(settings.fit)
        base = refit(case, Hypothesis(), fit, ranking.base.values)
        ranking = sharpen(case, ranking, base, fit, part(tell, 0.8, 1.0))
    return ranking, level


def climb(
    case: Case,
    witness: Witness,
    thresholds: Mapping[str, float] | None,
    tell: Progress,
    first_only: bool = False,
) -> Climb:
    """Add what is claimed, one effect after the other.

    Parameters
    ----------
    case : Case
    witness : Witness
        What its FRFs contradict is not added.
    thresholds : mapping of family to gain, optional
    tell : callable
    first_only : bool
        Nothing is ranked on top of the first effect.
    """
    settings = case.settings
    ranking, level = first_ranking(case, part(tell, 0.0, 0.8))
    fit = level.applied(settings.fit)
    models, rankings, refuted = [ranking.base], [ranking], False
    while True:
        claim, note = claimable(case, rankings[-1], fit, witness, thresholds)
        if claim is None:
            refuted = note != NOT_SUPPORTED
            break
        if len(models) > 1 and not _told_apart(case, rankings[-1], witness):
            note = (
                f"{claim.hypothesis.labels[-1]} or others like it may be missing too: too small to tell which"
            )
            break
        if len(models) > settings.most_rungs:
            note = f"stopped after {settings.most_rungs} effects"
            break
        models.append(claim)
        if first_only:
            note = "stopped after the first effect"
            rankings.append(Ranking(claim, (), {NOTHING: 1.0}))
            break
        rest = single_hypotheses(case.rig, list(case.measured), case.library, claim.hypothesis)
        told = part(tell, 0.8, 1.0)
        told(0.0, f"on top of {claim.hypothesis.label}")
        rankings.append(rank(case, claim, rest, fit, told))
        models[-1] = rankings[-1].base
    return Climb(models, rankings, level, note, refuted)


def _told_apart(case: Case, ranking: Ranking, witness: Witness) -> bool:
    """True where a further effect is told from rivals elsewhere, or a model that fails needs it anyway."""
    if not holds(ranking.base):
        return True
    places = {f.hypothesis.labels[-1].partition("@")[2] for f in group(case, ranking, witness)}
    return len(places) == 1


def claimable(
    case: Case,
    ranking: Ranking,
    fit: FitSettings,
    witness: Witness,
    thresholds: Mapping[str, float] | None,
) -> tuple[Fitted | None, str]:
    """The most probable hypothesis where something is missing for sure, and held-out data and FRFs agree.

    Returns
    -------
    Fitted or None
    str
        Why nothing is claimed.
    """
    settings = case.settings
    if 1 - ranking.probabilities[NOTHING] < settings.probability_least or not ranking.fitted:
        return None, NOT_SUPPORTED
    top = ranking.ordered()[0]
    if ranking.gain(top) < threshold(top.hypothesis.family, settings.gain_least, thresholds):
        return None, NOT_SUPPORTED
    stick = yardstick(case, fit, ranking.worthwhile())
    unseen = [held_out(case, f, fit, settings.folds) for f in (ranking.base, top)]
    label = top.hypothesis.labels[-1]
    if bound := at_bound(case, top):
        return None, f"{label} would have to be as large as is thought possible ({bound})"
    if not stick.heldout_score(unseen[1]) < stick.heldout_score(unseen[0]):
        before, after = (
            stick.heldout_error(f, out) for f, out in zip((ranking.base, top), unseen, strict=True)
        )
        return None, f"{label} does not improve held-out data (error {before:.3g} before, {after:.3g} after)"
    without, with_it = witness.error(ranking.base), witness.error(top)
    if witness.rejects(without, top, stick.error(top) <= settings.error_limit):
        return None, (
            f"the FRFs contradict {label}: error {without.error:.3g} before, {with_it.error:.3g} after"
        )
    return top, ""


def at_bound(case: Case, f: Fitted) -> str:
    """What an effect's fit pushes to the end of the range in which it makes sense; empty where nothing is.

    Data that only push a size away do not estimate it.
    """
    last = f.hypothesis.labels[-1]
    parameters = case.rig_of(f.hypothesis).parameters
    for e in extras(case.rig, Hypothesis((last,)), case.library):
        p, value = parameters[e.name], f.values.get(e.name)
        if value is None or p.unit == "deg" or p.minimum <= 0 or not np.isfinite(p.maximum):
            continue
        if value <= _NEAR_BOUND * p.minimum or value >= p.maximum / _NEAR_BOUND:
            return f"{e.name.removeprefix(f'{last}.')} {value:.3g} {p.unit}"
    return ""


def group(case: Case, ranking: Ranking, witness: Witness) -> list[Fitted]:
    """The smallest set of hypotheses that holds `probability_least` of all that is not "nothing".

    Rivals whose FRFs are clearly further from the measured ones than those of the first are left out.
    """
    something = 1 - ranking.probabilities[NOTHING]
    members: list[Fitted] = []
    held = 0.0
    for f in ranking.ordered():
        if members and held >= case.settings.probability_least * something:
            break
        held += ranking.probabilities[f.hypothesis.label]
        if not members or not witness.prefers(members[0], f):
            members.append(f)
    return members


def rivals(case: Case, climbed: Climb, witness: Witness) -> tuple[int, list[Fitted]]:
    """Of models with a claim: the first rung, from 0, whose claim the data do not tell from others, and all of these.

    Where every claim stands alone, the first rung and its claim.
    """
    groups = [group(case, ranking, witness) for ranking in climbed.rankings[: len(climbed.models) - 1]]
    rung = next((k for k, members in enumerate(groups) if len(members) > 1), 0)
    return rung, groups[rung]
