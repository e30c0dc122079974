"""Which effect is an isolator's model missing? From loops to a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ema_pipeline.diagnose.explain import label_text, size_text
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Candidate, Diagnosis, Ladder, Localisation, VerdictWord
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.loops.effects import PARAMETERS, effect_ids, label_of
from ema_pipeline.loops.explain import (
    limits_words,
    missing_words,
    next_loop,
    play_words,
    scales_words,
    where_it_falls,
)
from ema_pipeline.loops.fitting import Fitted
from ema_pipeline.loops.heldout import heldout_error
from ema_pipeline.loops.ladder import (
    Progress,
    assemble,
    effect_sizes,
    error_of,
    folds_of,
    known_sizes,
    loop_model,
    together,
)
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.regions import regions
from ema_pipeline.loops.search import Ranking, rank
from ema_pipeline.loops.settings import HysteresisSettings
from ema_pipeline.loops.types import Loop, LoopModel
from ema_pipeline.loops.visible import Limit, smallest_visible
from ema_pipeline.threads import single_blas_thread

NOTHING = "nothing"
_ALIKE = 0.03
_DOUBTFUL = 0.1
_BLIND = 0.1

Key = frozenset[str]


def diagnose_loops(
    loops: Sequence[Loop],
    added: Sequence[str] = (),
    settings: DiagnoseSettings | None = None,
    loop_settings: HysteresisSettings | None = None,
    progress: Progress | None = None,
) -> tuple[Diagnosis, tuple[LoopModel, ...]]:
    """Find the effects that an isolator's model is missing.

    Parameters
    ----------
    loops : sequence of Loop
    added : sequence of str
        Labels ``id@isolator`` that the model has already.
    settings : DiagnoseSettings, optional
    loop_settings : HysteresisSettings, optional
    progress : callable, optional
        Called with the share done (0…1) and a word on what is being done.

    Returns
    -------
    Diagnosis
        Hypotheses are sets of effects: `probabilities` are those of sets and add up to 1, a candidate's probability
        is that of all sets that hold it.
    tuple of LoopModel
        The models of the ladder beside the measured loops.

    Raises
    ------
    EmaError
        Without loops, and for added effects that a loop does not show.
    """
    settings, tell = settings or DiagnoseSettings(), progress or (lambda share, text: None)
    base = effect_ids(added)
    with single_blas_thread():
        cases = together(loops, loop_settings or HysteresisSettings())
        others = [e for e in PARAMETERS if e not in base]
        ranking = rank(cases, base, others, settings.null_prior, lambda share, text: tell(0.6 * share, text))
        judge = _Judge(ranking, settings, folds_of(cases, loop_settings or HysteresisSettings()))
        tell(0.6, "predicting loops held out")
        return judge.diagnosis(tell)


@dataclass(frozen=True)
class _Support:
    """What speaks for an effect of a set."""

    effect: str
    gain: float
    threshold: float
    heldout_before: float
    heldout_after: float

    def holds(self, share: float, least: float, settings: DiagnoseSettings) -> bool:
        better = not self.heldout_after >= self.heldout_before  # NaN where nothing can be held out
        return share >= least and self.gain >= max(self.threshold, settings.gain_least) and better


class _Judge:
    """Claims, groups and words from a ranking."""

    def __init__(
        self, ranking: Ranking, settings: DiagnoseSettings, left_out: Sequence[Sequence[int]]
    ) -> None:
        self.ranking, self.settings, self.left_out = ranking, settings, left_out
        self.loops: LoopSet = ranking.loops
        self.null: Key = frozenset(ranking.base)
        self._heldout: dict[Key, float] = {}
        self.found, self.groups = self._claims()

    def fitted(self, key: Key) -> Fitted:
        return self.ranking.fitted[key]

    def heldout(self, key: Key) -> float:
        if key not in self._heldout:
            self._heldout[key] = heldout_error(self.loops, self.fitted(key), self.left_out)
        return self._heldout[key]

    def support(self, key: Key, effect: str) -> _Support:
        least = self.settings.probability_least
        return _Support(
            effect,
            self.ranking.gain(key, effect),
            self.ranking.threshold(key, effect, least),
            self.heldout(key - {effect}),
            self.heldout(key),
        )

    def _claims(self) -> tuple[Key, tuple[tuple[str, ...], ...]]:
        """The largest set whose every effect is supported, and groups of effects that fit alike."""
        key: Key = self.ranking.best.structure.key
        groups = {e: self._alike(key, e) for e in key - self.null}
        while key != self.null:
            weak = []
            for effect in key - self.null:
                if key - {effect} not in self.ranking.fitted:
                    continue
                share = self._share((effect, *groups[effect]))
                s = self.support(key, effect)
                if not s.holds(share, self.settings.probability_least, self.settings):
                    weak.append(s)
            if not weak:
                break
            key = key - {min(weak, key=lambda s: s.gain).effect}
        chosen = tuple((label_of(e), *map(label_of, groups[e])) for e in sorted(key - self.null) if groups[e])
        return key, chosen

    def _share(self, effects: Sequence[str]) -> float:
        """Probability of all sets that hold one of some effects."""
        return float(sum(p for k, p in self.ranking.probabilities.items() if k & set(effects)))

    def _alike(self, key: Key, effect: str) -> tuple[str, ...]:
        """Effects that would do nearly as well in place of one."""
        found = []
        for other in PARAMETERS:
            swapped = key - {effect} | {other}
            if other not in key and swapped in self.ranking.fitted:
                odds = self.ranking.probabilities[swapped] / self.ranking.probabilities[key]
                found += [other] if odds > _ALIKE else []
        return tuple(found)

    def diagnosis(self, tell: Progress) -> tuple[Diagnosis, tuple[LoopModel, ...]]:
        """All of it."""
        models = self._rungs()
        ladder = self._ladder(models, tell)
        tell(0.85, "what the loops could show")
        limits = self._limits(models[-1])
        verdict, summary = self._verdict(ladder, limits)
        places = regions(self.loops, models[-1], self.ranking.widening) if verdict == "unknown_effect" else ()
        drawn = tuple(loop_model(self.loops, m) for m in models)
        tell(0.95, "next measurement")
        found = Diagnosis(
            verdict=verdict,
            summary=summary + _where(places),
            null_probability=self.ranking.probabilities[self.null],
            candidates=self._candidates(),
            indistinguishable=self.groups if verdict == "ambiguous" else (),
            next_measurement=self._next(verdict),
            localisation=places,
            probabilities={self._name(k): p for k, p in self.ranking.probabilities.items()},
            error=ladder.rungs[0].error,
            heldout_error=ladder.rungs[0].heldout_error,
            ladder=ladder,
            notes=(
                *scales_words(self.loops, models[-1]),
                *play_words(models[-1]),
                *missing_words(self.loops, drawn[-1], ladder.rungs[-1].error, self.settings.error_limit),
                *limits_words(limits),
            ),
        )
        tell(1.0, "done")
        return found, drawn

    def _name(self, key: Key) -> str:
        mine = [label_of(e) for e in PARAMETERS if e in key - self.null]
        return " + ".join(mine) or NOTHING

    def _rungs(self) -> list[Fitted]:
        """Models from the base to what was found, each adding the effect that mends most."""
        keys = [self.null]
        while keys[-1] != self.found:
            steps = [keys[-1] | {e} for e in self.found - keys[-1]]
            known = [k for k in steps if k in self.ranking.fitted]
            keys.append(min(known, key=lambda k: self.fitted(k).chi2) if known else self.found)
        order = list(self.ranking.base)
        models = []
        for key in keys:
            order += [e for e in PARAMETERS if e in key and e not in order]
            model = self.fitted(key)
            models.append(model.reordered(tuple(order)))
        return models

    def _ladder(self, models: Sequence[Fitted], tell: Progress) -> Ladder:
        note = "no further effect is supported by the loops"
        return assemble(
            self.loops,
            models,
            self.ranking.widening,
            self.left_out,
            note,
            lambda share, text: tell(0.65 + 0.2 * share, text),
            skipped=self.ranking.base,
        )

    def _limits(self, model: Fitted) -> tuple[Limit, ...]:
        effects = [e for e in PARAMETERS if e not in model.structure.effects]
        if not effects:
            return ()
        one = 1 - self.settings.null_prior ** (1 / (len(PARAMETERS) - len(self.null)))
        return tuple(
            smallest_visible(
                self.loops,
                model,
                e,
                self.ranking.widening,
                one / (1 - one),
                self.settings.probability_least,
            )
            for e in effects
        )

    def _candidates(self) -> tuple[Candidate, ...]:
        """Every effect, on top of what was found or taken from it."""
        found = []
        for effect in PARAMETERS:
            key = self.found | {effect}
            without = key - {effect}
            if effect in self.null or key not in self.ranking.fitted or without not in self.ranking.fitted:
                continue
            claimed = effect in self.found
            worth = claimed or self.ranking.share(effect) > 0.05
            s = self.support(key, effect) if worth else None
            fitted, threshold = self.fitted(key), self.ranking.threshold(key, effect, 0.9)
            known = known_sizes(fitted, self.ranking.widening)
            library = shipped_effects()[effect]
            found.append(
                Candidate(
                    effect=effect,
                    at=label_of(effect).partition("@")[2],
                    title=library.title,
                    probability=self.ranking.share(effect),
                    parameters=effect_sizes(known, effect),
                    error_before=error_of(self.loops, self.fitted(without)),
                    error_after=error_of(self.loops, fitted),
                    heldout_before=float("nan") if s is None else s.heldout_before,
                    heldout_error_after=float("nan") if s is None else s.heldout_after,
                    gain=self.ranking.gain(key, effect),
                    threshold=max(threshold, self.settings.gain_least),
                    log_evidence=self.ranking.log_evidence[key] - self.ranking.log_evidence[without],
                    claimed=claimed,
                    why=where_it_falls(self.loops, self.fitted(without), fitted, library.signs),
                )
            )
        return tuple(sorted(found, key=lambda c: (-c.probability, -c.gain)))

    def _verdict(self, ladder: Ladder, limits: Sequence[Limit]) -> tuple[VerdictWord, str]:
        first, last = ladder.rungs[0], ladder.rungs[-1]
        limit = self.settings.error_limit
        climbed = self._climbed(ladder)
        if not last.error <= limit:
            fails = f"The model fails (error {last.error:.3g}, {limit:g} is the limit)"
            return "unknown_effect", f"{climbed} {fails} and nothing in the library mends it.".strip()
        if not last.effects:
            blind = [one for one in limits if one.share > _BLIND]
            if len(blind) > len(PARAMETERS) / 2:
                return "not_enough_data", (
                    f"These loops would show only {len(limits) - len(blind)} of {len(limits)} effects at a tenth "
                    "of the force."
                )
            p = self.ranking.probabilities[self.null]
            return "adequate", (
                f"The model explains the loops (error {last.error:.2f}); nothing is missing ({100 * p:.0f} %)."
            )
        if self.groups:
            pairs = "; ".join(" or ".join(label_text(label) for label in g) for g in self.groups)
            return "ambiguous", f"Something is missing, but these explain the loops alike: {pairs}. {climbed}"
        known = last.parameters
        texts = [
            f"{label_text(label)} ({size_text({n: s for n, s in known.items() if n.startswith(label + '.')})})"
            for label in last.effects
        ]
        return "effect", (
            f"Missing: {' and '.join(texts)}. Error {first.error:.3g} before, {last.error:.3g} after; "
            f"on loops held out {first.heldout_error:.3g} and {last.heldout_error:.3g}."
        )

    def _climbed(self, ladder: Ladder) -> str:
        """What each rung brought, in one sentence."""
        steps, before = [], ladder.rungs[0]
        for rung in ladder.rungs[1:]:
            new = " and ".join(label_text(e) for e in rung.effects if e not in before.effects)
            steps.append(
                f"{new} (error {before.error:.3g} to {rung.error:.3g}, held out {before.heldout_error:.3g} to "
                f"{rung.heldout_error:.3g})"
            )
            before = rung
        if not steps:
            return ""
        return f"What matters: {', then '.join(steps)}."

    def _next(self, verdict: VerdictWord) -> str:
        doubtful = None
        if verdict == "ambiguous":
            first, second = effect_ids(self.groups[0][:2])
            doubtful = (self.found, self.found - {first} | {second}, f"{first} from {second}")
        elif verdict in ("adequate", "effect"):
            likely = [e for e in PARAMETERS if e not in self.found and self.ranking.share(e) > _DOUBTFUL]
            if likely and self.found | {likely[0]} in self.ranking.fitted:
                doubtful = (self.found | {likely[0]}, self.found, f"whether {likely[0]} is there")
        pair = None if doubtful is None else (self.fitted(doubtful[0]), self.fitted(doubtful[1]), doubtful[2])
        return next_loop(self.ranking, verdict, pair)


def _where(places: Sequence[Localisation]) -> str:
    if not places:
        return ""
    return f" Most of what is left sits on the {places[0].place}, and acts there like {places[0].acts_like}."
