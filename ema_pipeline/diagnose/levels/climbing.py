"""Effects that depend on the force level, added one after the other as far as the measured motion is followed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ema_pipeline.diagnose.hypotheses import NOTHING
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, error_of
from ema_pipeline.diagnose.levels.ladder import level_errors
from ema_pipeline.diagnose.levels.problem import NoiseFloor
from ema_pipeline.diagnose.levels.rungs import climb
from ema_pipeline.diagnose.levels.search import (
    LevelRanking,
    again,
    at_floor,
    own_floor,
    ranked,
    ranked_linear,
)
from ema_pipeline.diagnose.levels.views import holds, views
from ema_pipeline.diagnose.progress import Progress, part
from ema_pipeline.effects.library import depends_on_level

_FINER = 0.7
"""The floor of the noise is lowered where a further effect leaves less than this share of it."""

_DETERMINED = 2.0
"""A size that is claimed differs from nothing by more than so many standard deviations."""


@dataclass(frozen=True)
class Climbed:
    """Models from the base upwards, the rankings on top of each, and the windows that they were fitted to."""

    case: LevelCase
    models: list[Simulated]
    rankings: list[LevelRanking]
    floor: NoiseFloor
    note: str

    def holds(self, whole: LevelCase) -> bool:
        """True where the last model explains all hits of the whole case that it can foretell."""
        return holds(whole, self.case, self.models[-1], self.floor)


def started(case: LevelCase, effects: tuple[str, ...], tell: Progress) -> list[Simulated]:
    """Models with the effects that are known before anything is ranked."""
    tell(0.0, "base model")
    return climb(case, effects, case.floor, part(tell, 0.0, 0.1))


def climbed_views(
    case: LevelCase, effects: tuple[str, ...], start: list[Simulated], tell: Progress
) -> Climbed:
    """Add what is claimed, one effect after the other; on some of the hits, or their first part, where nothing holds.

    Teeth that part often, and friction that sticks, move so sensitively that the true model loses the measured motion:
    in some hits, or in time. What is left then is no sign of a further effect: the first view counts in which a model
    follows the motion.
    """
    climbs: list[_Climb] = []
    for view in views(case, lambda: climbs[0].best):
        climbs.append(_Climb(view, start if view is case else started(view, effects, tell), tell))
        climbed = climbs[-1].climbed(patient=False)
        if not climbs[-1].lost and climbed.holds(case):
            return climbed
    # what follows the motion follows its beginning: where nothing does, longer windows of the same hits are in vain
    *longer, shortest = climbs
    end = shortest.climbed(patient=True)
    within = end.holds(case)
    for climb_on in longer:
        if within or climb_on.case.left_out:
            further = climb_on.climbed(patient=True)
            if further.holds(case):
                return further
    return end


class _Climb:
    """Rank on the base model, lower the noise to what the best leaves, add what is claimed, and rank again."""

    def __init__(self, case: LevelCase, start: list[Simulated], tell: Progress) -> None:
        self.case, self.start = case, start
        first = ranked(case, start[-1], case.floor, part(tell, 0.1, 0.5))
        self.floor = own_floor(case, _best(first))
        self.rankings = [at_floor(case, first, self.floor, part(tell, 0.5, 0.6))]
        self.tell = part(tell, 0.6, 0.8)

    @property
    def best(self) -> Simulated:
        """The model of the largest evidence on the first rung."""
        return _best(self.rankings[0])

    @property
    def lost(self) -> bool:
        """True where no model follows the motion within the largest own error."""
        return self.floor.own >= self.case.settings.levels.noise_most

    def climbed(self, patient: bool) -> Climbed:
        """As far as it goes; without patience only while a model follows the motion."""
        case, rankings, tell, s = self.case, self.rankings, self.tell, self.case.settings
        while True:
            if self.lost and (not patient or self._as_good_as_it_gets()):
                note = "stopped where no model follows the motion"
                break
            top = _claimable(case, rankings[-1], self.floor)
            if top is None and self.lost:
                # what depends on the level cannot mend it alone: something else may be missing at every level
                linear = ranked_linear(case, rankings[-1].base, self.floor, tell)
                rankings[-1] = _with(case, rankings[-1], linear)
                top = _claimable(case, rankings[-1], self.floor)
            if top is None:
                note = "no further effect is supported by the data"
                break
            if len(rankings) > s.most_rungs:
                note = f"stopped after {s.most_rungs} effects"
                break
            rankings.append(ranked(case, top, self.floor, tell))
            finer = own_floor(case, _best(rankings[-1]))
            if finer.own < _FINER * self.floor.own:
                self.floor = finer
                rankings[:] = [at_floor(case, r, self.floor, tell) for r in rankings]
        self._without_undetermined()
        models = [*(again(case, m, self.floor) for m in self.start[:-1]), *(r.base for r in rankings)]
        return Climbed(case, models, list(rankings), self.floor, note)

    def _without_undetermined(self) -> None:
        """Take back what looked like a size at a higher floor of the noise, and lower the floor no further than it
        was."""
        kept = len(self.rankings)
        while kept > 1 and not _determined(self.case, self.rankings[kept - 1].base):
            kept -= 1
        if kept < len(self.rankings):
            del self.rankings[kept:]
            self.floor = own_floor(self.case, _best(self.rankings[-1]))
            self.rankings[:] = [at_floor(self.case, r, self.floor, self.tell) for r in self.rankings]

    def _as_good_as_it_gets(self) -> bool:
        """True for a model within the limit that has an effect after which motion is lost."""
        base = self.rankings[-1].base
        known = any(depends_on_level(x, self.case.library) for x in base.hypothesis.labels)
        return known and error_of(self.case, base) <= self.case.settings.error_limit


def _best(ranking: LevelRanking) -> Simulated:
    """The model of the largest evidence."""
    return min((ranking.base, *ranking.fitted), key=lambda m: m.evidence)


def _with(case: LevelCase, one: LevelRanking, other: LevelRanking) -> LevelRanking:
    """Both rankings of the same base model as one."""
    base = min(one.base, other.base, key=lambda m: m.fit.objective)
    return LevelRanking(case, base, [*one.fitted, *other.fitted])


def _claimable(case: LevelCase, ranking: LevelRanking, floor: NoiseFloor) -> Simulated | None:
    """The most probable hypothesis where something is missing for sure and held-out levels agree."""
    s = case.settings
    if 1 - ranking.probabilities[NOTHING] < s.probability_least or not ranking.fitted:
        return None
    top = ranking.ordered()[0]
    if ranking.gain(top) < s.levels.gain_least or not _determined(case, top):
        return None
    before, after = (level_errors(case, m, floor).heldout_error for m in (ranking.base, top))
    return top if not after >= before else None


def _determined(case: LevelCase, model: Simulated) -> bool:
    """True where the size of the effect added last differs from nothing.

    Friction that never turns over is a damper: only the ratio of its force to its rate is told, and no force.
    """
    label = model.hypothesis.labels[-1]
    return all(
        np.isinf(p.null) or abs(model.values[name]) > _DETERMINED * model.std[name]
        for p in case.parameters_of(label)[:1]
        if (name := f"{label}.{p.name}") in model.sizes
    )
