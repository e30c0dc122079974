"""Which hypotheses explain the data alike, what a further effect must gain, and what of it is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ema_pipeline.diagnose import diagnosis, probability, rounds, selection
from ema_pipeline.diagnose.claims import (
    BETTER_CONTRADICTED,
    BETTER_DOUBTED,
    MAY_BE_ZERO,
    NO_LESS_ERROR,
    PREDICTED_WORSE,
    Judged,
)
from ema_pipeline.diagnose.diagnosis import _candidates, _ended, _first_probabilities, _groups
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.diagnose.rounds import Round
from ema_pipeline.diagnose.selection import Earlier, Selection, _beside, select
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, EffectSize
from ema_pipeline.diagnose.verdict import alike

SETTINGS = DiagnoseSettings(alike=3.0, claim=3.5, linearised=0.1, candidates=5)


def judged(
    label: str,
    gain: float,
    doubt: str = "",
    generic: bool = False,
    specific: bool = True,
    linear: bool = True,
    equivalents: tuple[str, ...] = (),
) -> Any:
    """A hypothesis with what it gains; every number of it another one."""
    effect_id, _, place = label.partition("@")
    effect = SimpleNamespace(
        id=effect_id, title=f"title of {label}", signs="signs", linear=linear, generic=generic
    )
    placed = SimpleNamespace(effect=effect, place=place, label=label)
    fit = SimpleNamespace(model=f"model of {label}", log_evidence=100.0 + gain)
    hypothesis = SimpleNamespace(label=label, generic=generic, placed=placed)
    return SimpleNamespace(
        hypothesis=hypothesis,
        ranked=SimpleNamespace(hypothesis=hypothesis, fit=fit),
        named=SimpleNamespace(
            label=label,
            name=SimpleNamespace(placed=placed),
            equivalents=equivalents,
            sizes={"size": EffectSize(gain, 0.1, "N")},
        ),
        gain=gain,
        needed=3.5,
        specific=specific and not generic,
        doubt=doubt,
        claimed=not doubt,
        contradicted=doubt in (NO_LESS_ERROR, PREDICTED_WORSE),
        may_be_zero=doubt.startswith(MAY_BE_ZERO),
        base=SimpleNamespace(posterior=SimpleNamespace(error=2.0)),
        after=SimpleNamespace(posterior=SimpleNamespace(error=1.0)),
        held_before=SimpleNamespace(error=3.0),
        held_after=SimpleNamespace(error=1.5),
    )


def a_round(*found: Any, told: dict[str, float] | None = None) -> Round:
    ranking: Any = SimpleNamespace(ranked=(), base=None, unpaired=0.0, linearised=False)
    return Round(ranking, tuple(found), told or {})


def labels(found: tuple[Any, ...]) -> list[str]:
    return [j.hypothesis.label for j in found]


def test_the_best_is_the_first_that_is_claimed_and_rivals_need_not_be() -> None:
    better = judged("spring@m1", 12.0, "held-out data")
    best = judged("mass@m2", 10.0)
    near = judged("damper@m3", 7.1, "weak")
    far = judged("mass@m4", 7.0)
    one = a_round(better, best, near, far)
    assert one.best is best
    assert labels(one.alike(SETTINGS)) == [
        "mass@m2",
        "spring@m1",
        "damper@m3",
    ]  # in order of names: the first is not behind
    assert a_round(better, near).best is None
    assert a_round(better, near).alike(SETTINGS) == ()


def test_a_rival_whose_size_may_be_zero_is_none() -> None:
    best, stuck = (
        judged("mass@m2", 18.5),
        judged("gyroscopic@sun", 59.6, f"{MAY_BE_ZERO} 2 standard deviations"),
    )
    assert labels(a_round(stuck, best).alike(SETTINGS)) == ["mass@m2"]


def test_a_rival_that_gains_nothing_is_none() -> None:
    one = a_round(
        judged("mass@m2", 2.0), judged("spring@m1", 0.0), judged("spring@m3", -0.5), judged("a@b", 0.1)
    )
    assert labels(one.alike(SETTINGS)) == ["mass@m2", "a@b"]


def test_the_rigs_own_come_before_generic_ones_and_ties_are_in_the_order_of_names() -> None:
    one = a_round(
        judged("z@own", 9.0),
        judged("b@own", 8.95),
        judged("a@generic", 9.0, generic=True),
        judged("c@own", 7.0),
        judged("a@own", 8.85),
        judged("a@part", 8.0, specific=False),
    )
    assert labels(one.alike(SETTINGS)) == ["b@own", "z@own", "a@own", "c@own", "a@generic", "a@part"]


def test_a_further_effect_must_gain_a_share_of_what_those_gained_that_are_linearised() -> None:
    claimed = [
        judged("cubic@a", 50.0, linear=False),
        judged("mass@a", 1e3),
        judged("friction@b", 20.0, linear=False),
    ]
    levels: Any = SimpleNamespace(linearised=True)
    asked = _beside(levels, SETTINGS, claimed)
    assert asked.claim == pytest.approx(3.5 + 0.1 * 70.0 + SETTINGS.linearised_claim)
    assert asked.alike == SETTINGS.alike
    assert _beside(levels, SETTINGS, claimed[1:2]).claim == 3.5


@pytest.mark.parametrize(("doubt", "beside"), [(0.2, 0.05), (0.03, 0.03)])
def test_a_further_effect_must_be_surer(doubt: float, beside: float) -> None:
    """A wrong name beside a right one spoils both."""
    settings = SETTINGS.model_copy(update={"doubt": doubt})
    modes: Any = SimpleNamespace(linearised=False)
    assert _beside(modes, settings, []) == settings
    asked = _beside(modes, settings, [judged("cubic@a", 50.0, linear=False)])
    assert asked == settings.model_copy(update={"doubt": beside})


def posterior_of(error: float) -> Any:
    return SimpleNamespace(posterior=SimpleNamespace(error=error, fails=lambda most: error > most))


class Steps:
    """Stands for all that `select` asks: rounds as they are written down."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, rounds: list[list[Any]], linearised: bool = False
    ) -> None:
        self.rounds, self.asked, self.begun, self.shares = rounds, [], [], []
        self.ranked: dict[int, tuple[Any, ...]] = {}
        self.before: list[Any] = []
        self.reached: list[Any] = []
        self.observations: Any = SimpleNamespace(
            linearised=linearised,
            suited=lambda effects: self.observations,
            about=lambda effects, found: self.observations,
        )
        monkeypatch.setattr(selection, "fit_base", self.fit_base)
        monkeypatch.setattr(selection, "rank", self.rank)
        monkeypatch.setattr(selection, "round_of", self.round)
        self.error = 1.0
        monkeypatch.setattr(selection, "within_scatter", lambda o, fit: posterior_of(self.error))
        self.reconsidered: list[tuple[list[str], list[str]]] = []
        monkeypatch.setattr(selection, "reconsidered", self.reconsider)
        for found in rounds:
            for j in found:
                j.ranked.fit.model = SimpleNamespace(effects=(j.hypothesis.placed,), name=j.hypothesis.label)

    def reconsider(self, observations: Any, start: Any, claimed: Any, rivals: Any, settings: Any) -> Any:
        assert start.model.name == "base"
        self.reconsidered.append((labels(claimed), [*rivals]))
        return claimed

    def fit_base(self, observations: Any, model: Any, start: Any = None) -> Any:
        self.begun.append((getattr(model, "name", "base"), start))
        return SimpleNamespace(model=model, at=len(self.begun), posterior=None)

    def rank(self, observations, base, left, processes, progress, further, unpaired, before, reached) -> Any:
        progress(0.5, "half")
        self.reached.append(reached)
        self.asked.append(([h.label for h in left], unpaired))
        self.before.append(before)
        ranked = self.ranked.get(len(self.asked), ())
        return SimpleNamespace(base=base, ranked=ranked, unpaired=10.0 * len(self.asked))

    def round(self, observations, ranking, among, settings, found) -> Round:
        self.shares.append((len(among), settings.claim, found))
        return Round(ranking, tuple(self.rounds[found]), {})

    def select(
        self,
        hypotheses: list[Any],
        settings: DiagnoseSettings,
        told: list[float],
        earlier: Earlier | None = None,
    ) -> Selection:
        known: Any = SimpleNamespace(effects=(), name="base")

        def progress(share: float, text: str) -> None:
            told.append(share)

        return select(self.observations, known, hypotheses, settings, progress, earlier or Earlier())


@pytest.mark.parametrize("closed", [True, False])
def test_what_is_asked_about_alone_is_all_that_is_asked_about_where_nothing_else_may_be(
    closed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b, c = judged("a@x", 20.0), judged("b@y", 9.0, "weak"), judged("c@z", 8.0, "weak")
    steps = Steps(monkeypatch, [[a], [b]])
    earlier = Earlier((a.hypothesis, b.hypothesis), 4, closed=closed)
    found = steps.select([j.hypothesis for j in (c, b, a)], SETTINGS, [], earlier)
    assert found.claimed == (a,)
    asked = [labels for labels, _ in steps.asked]
    # else all that led is asked about at once, and everything where that leads nowhere
    assert asked == ([["a@x"], ["b@y"]] if closed else [["b@y", "a@x"], ["b@y"], ["c@z", "b@y"]])
    assert {among for among, _, found in steps.shares if not found} == {3}  # the others keep their prior
    steps = Steps(monkeypatch, [[b]])
    assert steps.select([j.hypothesis for j in (c, b, a)], SETTINGS, [], earlier).claimed == ()
    assert len(steps.asked) == (1 if closed else 2)


def test_effects_are_added_one_by_one_until_nothing_more_is_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, c = judged("a@x", 20.0, linear=False), judged("b@y", 9.0), judged("c@y", 4.0, "weak")
    rival = judged("b@z", 9.05, "weak")  # would stand first among those alike
    steps = Steps(monkeypatch, [[a], [rival, b], [c]], linearised=True)
    told: list[float] = []
    found = steps.select([j.hypothesis for j in (a, b, c)], SETTINGS, told)
    assert found.claimed == (a, b)
    assert len(found.rounds) == 3
    assert steps.asked == [(["a@x", "b@y", "c@y"], 0.0), (["b@y", "c@y"], 10.0), (["c@y"], 20.0)]
    assert [name for name, _ in steps.begun] == ["base", "a@x", "b@y"]
    assert steps.begun[1][1] is a.ranked.fit
    # the next base is no worse than what was claimed
    assert steps.reached == [[], [a.ranked.fit], [b.ranked.fit]]
    assert found.final is found.rounds[-1].ranking.base
    assert found.final.at == 3  # type: ignore[attr-defined]
    more = pytest.approx(5.5 + SETTINGS.linearised_claim)
    assert steps.shares == [(3, 3.5, 0), (2, more, 1), (1, more, 2)]
    assert told == pytest.approx([0.125, 0.375, 0.625])
    assert steps.reconsidered == [(["a@x", "b@y"], ["a@x", "b@y"])]  # one alone has nothing beside it


def test_a_claim_that_another_one_has_changed_is_built_on_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claims hold arrays, which have no truth: they are the same where they are the same objects."""
    a, b = judged("a@x", 20.0), judged("b@y", 9.0)
    a.samples = np.zeros(2)
    changed = SimpleNamespace(**{**vars(a), "samples": np.zeros(2)})
    steps = Steps(monkeypatch, [[a], [b], []])
    monkeypatch.setattr(selection, "reconsidered", lambda o, start, claimed, rivals, settings: [changed, b])
    found = steps.select([a.hypothesis, b.hypothesis], SETTINGS, [])
    assert found.claimed[0] is changed
    assert found.claimed[1] is b


@pytest.mark.parametrize(("anew", "continued", "best"), [(3.0, 2.0, "anew"), (2.0, 3.0, "continued")])
def test_the_known_model_is_also_fitted_from_data_with_fewer_unknowns(
    monkeypatch: pytest.MonkeyPatch, anew: float, continued: float, best: str
) -> None:
    plain, suited, model = SimpleNamespace(), SimpleNamespace(), SimpleNamespace()
    model.problem = lambda data: SimpleNamespace(unknowns=("of suited", data is suited))
    fits = {
        id(suited): SimpleNamespace(name="anew", log_evidence=anew),
        id(plain): SimpleNamespace(posterior="p"),
    }
    monkeypatch.setattr(selection, "fit_base", lambda data, known: fits[id(data)])
    monkeypatch.setattr(selection, "transferred", lambda posterior, unknowns: (posterior, unknowns))

    def refined(data: Any, known: Any, start: Any, steps: int) -> Any:
        assert start == ("p", ("of suited", True))
        return SimpleNamespace(name="continued", log_evidence=continued)

    monkeypatch.setattr(selection, "refined", refined)
    assert selection._fitted(suited, plain, model).name == best  # type: ignore[arg-type, attr-defined]
    assert selection._fitted(suited, suited, model).name == "anew"  # type: ignore[arg-type, attr-defined]


def test_linear_effects_at_the_place_of_a_linearised_one_are_not_asked_about(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    a, other = judged("backlash@x", 20.0, linear=False), judged("cubic@x", 1.0, "weak", linear=False)
    loss, far = judged("loss@x", 9.0), judged("loss@y", 1.0, "weak")
    hypotheses = [j.hypothesis for j in (a, other, loss, far)]
    steps = Steps(monkeypatch, [[a], [far]], linearised=True)
    steps.select(hypotheses, SETTINGS, [])
    assert [asked for asked, _ in steps.asked[1:]] == [["cubic@x", "loss@y"]]
    steps = Steps(monkeypatch, [[a], [far]])
    steps.select(hypotheses, SETTINGS, [])
    assert [asked for asked, _ in steps.asked[1:]] == [["cubic@x", "loss@x", "loss@y"]]


@pytest.mark.parametrize("leads", [True, False])
def test_what_was_claimed_is_asked_about_again_with_unknowns_that_a_later_claim_calls_for(
    monkeypatch: pytest.MonkeyPatch, leads: bool
) -> None:
    a, b, c = judged("a@x", 20.0), judged("b@x", 9.0), judged("c@x", 1.0, "weak")
    steps = Steps(monkeypatch, [[a], [b], [c]])
    more: Any = SimpleNamespace(
        linearised=False, suited=lambda effects: more, about=lambda effects, found: more
    )
    steps.observations.suited = lambda effects: more if b.hypothesis.placed in effects else steps.observations
    steps.ranked = {
        k: tuple(
            SimpleNamespace(
                hypothesis=j.hypothesis,
                gain=j.gain,
                fit=SimpleNamespace(posterior=f"{j.hypothesis.label} {k}"),
            )
            for j in of
        )
        for k, of in ((1, (a, b)), (2, (b, c)))
    }
    asked_round = steps.round

    def round_of(observations: Any, ranking: Any, among: Any, settings: Any, found: int) -> Any:
        nothing = not leads and len(steps.asked) == 3
        return asked_round(observations, ranking, among, settings, 2 if nothing else found)

    monkeypatch.setattr(selection, "round_of", round_of)
    d = judged("d@x", 0.5, "weak")
    found = steps.select([j.hypothesis for j in (a, b, c, d)], SETTINGS, [])
    led = ["a@x", "b@x", "c@x"]  # what was claimed first, and what led when more unknowns were called for
    again = [] if leads else [[*led, "d@x"]]  # of all, where that leads nowhere
    assert [asked for asked, _ in steps.asked] == [
        [*led, "d@x"], ["b@x", "c@x", "d@x"],
        led, *again, ["b@x", "c@x"],
        ["c@x", "d@x"],
    ]  # fmt: skip
    assert found.claimed == (a, b)
    assert found.observations is more
    fitted = {"a@x": "a@x 1", "b@x": "b@x 2", "c@x": "c@x 2"}  # where fits of the first pass ended
    assert steps.before == [{}, {}, *[fitted] * (3 + len(again))]


def as_judged(label: str, gain: float, doubt: str) -> Judged:
    like = judged(label, gain)
    like.ranked.fit.log_evidence = 100.0 + gain
    return Judged(
        like.ranked, like.named, gain, like.base, like.after, like.held_before, like.held_after, doubt, 3.5
    )


@pytest.mark.parametrize(("second_doubt", "holds"), [("", True), ("", False), ("weak", False)])
@pytest.mark.parametrize("doubt", [PREDICTED_WORSE, NO_LESS_ERROR, "its gain is too small"])
def test_an_effect_that_cannot_be_claimed_alone_is_claimed_where_it_holds_with_a_second_one(
    monkeypatch: pytest.MonkeyPatch, doubt: str, second_doubt: str, holds: bool
) -> None:
    leads = doubt in (PREDICTED_WORSE, NO_LESS_ERROR)
    a, rival = as_judged("a@x", 29.0 if leads else -11.0, doubt), as_judged("r@x", 20.0, BETTER_CONTRADICTED)
    b, c = as_judged("b@x", 21.0, second_doubt), as_judged("c@x", 1.0, "weak")
    a = dataclasses.replace(a, after=posterior_of(0.9))  # reduces the error most
    steps = Steps(monkeypatch, [[a, rival] if leads else [rival, a], [b], [c]])
    steps.error = 1.0 if leads else 1.51
    asked: list[float] = []

    def judge(observations: Any, ranking: Any, ranked: Any, settings: Any) -> Any:
        asked.append(ranked.gain)  # of both, on top of the model without either
        return SimpleNamespace(claimed=holds, gain=40.0)

    monkeypatch.setattr(selection, "judge", judge)
    monkeypatch.setattr(selection, "replace", replaced)
    monkeypatch.setattr(selection, "weighed", lambda ranking, found, *rest: Round(ranking, tuple(found), {}))
    monkeypatch.setattr(
        selection,
        "fit_base",
        lambda o, m, start=None: SimpleNamespace(model=m, log_evidence=100.0, posterior=None),
    )
    monkeypatch.setattr(selection, "alike_beside", lambda *given: ())
    found = steps.select([j.hypothesis for j in (a, rival, b, c)], SETTINGS, [])
    assert asked == ([] if second_doubt else [21.0])
    assert [j.hypothesis.label for j in found.claimed] == (["a@x", "b@x"] if holds else [])
    # what was asked ahead is not asked again
    assert [len(left) for left, _ in steps.asked] == ([4, 3, 2] if holds else [4, 3])
    first = found.rounds[0].judged
    if holds:
        assert [(j.hypothesis.label, j.gain, j.doubt) for j in first] == [
            ("a@x", 29.0 if leads else 40.0, ""),
            ("r@x", 20.0, ""),
        ]
    else:
        assert first == ((a, rival) if leads else (rival, a))


def test_what_reduces_the_error_most_is_tried_where_no_second_effect_holds_beside_what_leads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    leads, least = as_judged("a@x", 20.0, NO_LESS_ERROR), as_judged("b@x", -1.0, "weak")
    leads = dataclasses.replace(leads, after=posterior_of(2.0))
    least = dataclasses.replace(least, after=posterior_of(0.9))
    second = as_judged("c@x", 21.0, "")
    steps = Steps(monkeypatch, [[leads, least], [second]])
    steps.error = 1.51
    tried: list[str] = []

    def both(observations: Any, found: Any, further: Any, settings: Any) -> Any:
        tried.append(steps.begun[-1][0])
        return None

    monkeypatch.setattr(selection, "_both", both)
    assert steps.select([j.hypothesis for j in (leads, least, second)], SETTINGS, []).claimed == ()
    assert tried == ["a@x", "b@x"]


def test_what_was_found_beside_an_effect_that_carries_no_claim_is_asked_for_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The damper that led gained nothing, but beside it the fit of a mass did not stay at nothing as it had alone."""
    damper, lost = as_judged("a@x", 1.4, PREDICTED_WORSE), as_judged("b@x", -9.0, "weak")
    mass = as_judged("b@x", 50.0, "")
    mass.ranked.fit.posterior = "where it was found"
    steps = Steps(monkeypatch, [[damper, lost], [mass]])
    judged_then = iter([(damper, lost), (mass,), (mass,), ()])
    monkeypatch.setattr(
        selection, "round_of", lambda o, ranking, *rest: Round(ranking, next(judged_then), {})
    )
    monkeypatch.setattr(selection, "_both", lambda *given: mass)
    monkeypatch.setattr(selection, "_acquitted", lambda found, *rest: found)
    monkeypatch.setattr(selection, "alike_beside", lambda *given: ())
    found = steps.select([damper.hypothesis, mass.hypothesis], SETTINGS, [])
    assert [j.hypothesis.label for j in found.claimed] == ["b@x"]
    # both alone, the mass beside the damper, both alone from where the mass was found, what else there is
    assert [asked for asked, _ in steps.asked] == [["a@x", "b@x"], ["b@x"], ["a@x", "b@x"], ["a@x"]]
    assert [begun for begun, _ in steps.begun] == ["base", "a@x", "b@x"]
    assert steps.before == [{}, {}, {"b@x": "where it was found"}, {}]


@pytest.mark.parametrize(("error", "linearised"), [(1.5, False), (1.51, True)])
def test_a_model_that_explains_the_data_or_is_linearised_calls_for_no_pairs(
    monkeypatch: pytest.MonkeyPatch, error: float, linearised: bool
) -> None:
    a = as_judged("a@x", 1.0, "weak")
    steps = Steps(monkeypatch, [[a]], linearised)
    steps.error = error
    assert steps.select([a.hypothesis], SETTINGS, []).claimed == ()
    assert len(steps.asked) == 1


@pytest.mark.parametrize(
    ("error", "lost", "relief"), [(1.51, 14.0, 14.0), (1.5, 14.9, 0.0), (1.5, 15.1, 15.1)]
)
def test_a_base_model_that_fails_once_no_part_stands_out_counts_with_that_fit(
    monkeypatch: pytest.MonkeyPatch, error: float, lost: float, relief: float
) -> None:
    """So does one that loses much evidence with the part.

    Where an effect that changes just that part explains the data with none that stands out, it is helped to the
    difference, and so is everything that explains them so: else a mass at the part that stands out takes the place of a
    true spring. What was learned with that part is learned again without it.
    """

    def fit(log_evidence: float, error: float, bounded: Any = None, cosine: float = 0.96) -> Any:
        jacobian = np.array([[1.0, cosine], [0.0, np.sqrt(1 - cosine**2)]])
        posterior = SimpleNamespace(
            log_evidence=log_evidence, evidence_at_scatters=log_evidence + 1.0, error=error,
            fails=lambda most: error > most,
            residuals=SimpleNamespace(weighted=(None, jacobian)),
            unknowns=SimpleNamespace(names=("m1", "mass@m1.mass"), index={"m1": 0, "mass@m1.mass": 1}),
        )  # fmt: skip
        return SimpleNamespace(posterior=posterior, log_evidence=log_evidence, bounded=bounded)

    def ranked(label: str, gain: float, of: Any, final: bool = True) -> Ranked:
        effect = SimpleNamespace(parameters=(SimpleNamespace(name="mass"),))
        placed = SimpleNamespace(effect=effect, parameter_name=lambda name: f"mass@m1.{name}")
        return Ranked(SimpleNamespace(label=label, placed=placed), of, gain, final)  # type: ignore[arg-type]

    monkeypatch.setattr(rounds, "within_scatter", lambda o, one: one.bounded or one)
    monkeypatch.setattr(rounds, "learned", lambda o, one, past_barriers: one)
    monkeypatch.setattr(rounds, "part_reach", lambda o, p: {"m1": 0.1})
    monkeypatch.setattr(rounds, "beyond", lambda p, most: np.array([True, False]))
    base = fit(60.0, 1.0, fit(60.0 - lost, error))
    given = Ranking(
        base,
        (
            ranked("bends a part", 9.0, fit(69.0, 1.0, fit(68.0, 1.2, fit(67.0, 1.2)))),
            ranked("bends a part, but need not", 8.0, fit(68.0, 1.0, fit(67.9, 1.2))),
            ranked("explains better", 3.5, fit(63.5, 0.5, cosine=0.1)),
            ranked("explains", 3.0, fit(63.0, 1.5)),
            ranked("at another part", 2.5, fit(62.5, 1.0, cosine=0.94)),
            ranked("fails", 2.0, fit(62.0, 1.51)),
            ranked("no finalist", 1.0, fit(61.0, 1.0), final=False),
        ),
    )
    data: Any = None
    found = rounds._with_relief(data, given, SETTINGS)
    straight = 7.9 + relief if relief else 8.0
    expected = [("bends a part", 9.0), ("bends a part, but need not", straight), ("fails", 2.0)]
    expected += [("explains better", 3.5 + relief), ("explains", 3.0 + relief)]
    expected += [("at another part", 2.5 + relief), ("no finalist", 1.0)]
    expected.sort(key=lambda one: -one[1])
    assert [r.hypothesis.label for r in found.ranked] == [label for label, _ in expected]
    assert [r.gain for r in found.ranked] == pytest.approx([gain for _, gain in expected])
    assert found.base is base
    elsewhere = dataclasses.replace(
        given, ranked=given.ranked[2:3]
    )  # nothing there changes what the part changes
    assert rounds._with_relief(data, elsewhere, SETTINGS) is elsewhere


def test_where_the_base_model_fails_at_usual_scatters_effects_are_compared_at_these(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those that need no more than these are helped to what the base model loses there, less what they lose."""

    def fit(evidence: float, held: float, error: float = 1.0, damped: bool = False) -> Any:
        def posterior(told: float) -> Any:
            return SimpleNamespace(evidence_at_scatters=told, fails=lambda most: error > most)

        usual = SimpleNamespace(posterior=posterior(held), damped=damped)
        return SimpleNamespace(posterior=posterior(evidence), usual=usual, damped=True)

    def ranked(label: str, gain: float, of: Any, final: bool = True) -> Ranked:
        return Ranked(SimpleNamespace(label=label), of, gain, final)  # type: ignore[arg-type]

    base, needs_more = fit(60.0, 54.0), True
    monkeypatch.setattr(
        rounds, "fails_at_usual_scatters", lambda o, one, settings: needs_more and one is base
    )
    monkeypatch.setattr(rounds, "with_usual_scatters", lambda o, one: one.usual)
    monkeypatch.setattr(rounds, "outlying_damping", lambda o, one: one if one.damped else None)
    monkeypatch.setattr(rounds, "within_scatter", lambda o, one: one)
    given = Ranking(
        base,
        (
            ranked("fails", 3.3, fit(63.3, 62.0, error=1.51)),
            ranked("explains", 3.2, fit(63.2, 63.0)),
            ranked("damping scatters", 3.1, fit(63.1, 63.0, damped=True)),
            ranked("loses more", 3.0, fit(63.0, 56.9)),
            ranked("no finalist", 2.0, fit(62.0, 62.0), final=False),
        ),
    )
    data: Any = None
    found = rounds._at_usual_scatters(data, given, SETTINGS)
    assert [r.hypothesis.label for r in found.ranked][:2] == ["explains", "fails"]
    gains = {r.hypothesis.label: r.gain for r in found.ranked}
    assert gains.pop("explains") == pytest.approx(3.2 + 6.0 - 0.2)
    assert gains == {"fails": 3.3, "damping scatters": 3.1, "loses more": 3.0, "no finalist": 2.0}
    needs_more = False
    assert rounds._at_usual_scatters(data, given, SETTINGS) is given


@pytest.mark.parametrize(
    ("linearisation", "behind", "predicts", "rough", "level"),
    [
        (17.0, 12.0, -9.0, False, True),
        (17.0, 12.0, -11.0, False, False),
        (17.0, 18.0, -9.0, False, False),
        (0.0, 1.0, -9.0, False, False),
        (17.0, 8.0, -11.0, True, True),
        (17.0, 12.0, -11.0, True, False),
    ],
)
def test_a_rival_is_level_where_linearisation_may_account_for_the_lead_and_it_predicts_better_or_is_friction(
    monkeypatch: pytest.MonkeyPatch,
    linearisation: float,
    behind: float,
    predicts: float,
    rough: bool,
    level: bool,
) -> None:
    """Teeth that part at the ring were 11.7 behind those at the sun, which held-out hits spoke against by 14; friction
    between two masses of a chain was 7.4 behind friction of another."""

    def rival(label: str, gain: float, density: float) -> Any:
        one = judged(label, gain, linear=False)
        one.held_after, one.linearisation = SimpleNamespace(log_density=density), linearisation
        return one

    sun, ring = rival("backlash@sun", 150.0, -10.0), rival("backlash@ring", 150.0 - behind, predicts)
    known = {"sun": sun, "ring": ring}
    ranked = tuple(SimpleNamespace(final=True, gain=j.gain, name=name) for name, j in known.items())
    given: Any = SimpleNamespace(ranked=ranked)
    for name in ("_with_relief", "_at_usual_scatters"):
        monkeypatch.setattr(rounds, name, lambda o, ranking, settings: ranking)
    monkeypatch.setattr(rounds, "probabilities", lambda *asked: {NOTHING: 0.0})
    monkeypatch.setattr(rounds, "judge", lambda o, ranking, one, *rest: known[one.name])
    monkeypatch.setattr(rounds, "replace", replaced)
    monkeypatch.setattr(rounds, "weighed", lambda ranking, found, *rest: found)
    data: Any = SimpleNamespace(in_full=lambda effects, found: (1, 2) if rough else None)
    told: Any = rounds.round_of(data, given, [], SETTINGS, 0)
    assert [j.gain for j in told] == [150.0, 150.0 - (0.2 if level else behind)]


def replaced(one: Any, **changes: Any) -> Any:
    """`replace` for what stands for a dataclass, too."""
    if isinstance(one, SimpleNamespace):
        return SimpleNamespace(**(vars(one) | changes))
    return dataclasses.replace(one, **changes)


@pytest.mark.parametrize(
    ("linearisation", "doubt", "needed", "passes_by_chance"),
    [
        (17.0, PREDICTED_WORSE, 20.5, True),
        (17.0, "its gain is below 37.5", 37.5, False),
        (17.0, "", 20.5, False),
        (0.0, PREDICTED_WORSE, 20.5, False),
    ],
)
def test_a_linearised_effect_is_one_of_many_where_a_better_one_is_doubted(
    linearisation: float, doubt: str, needed: float, passes_by_chance: bool
) -> None:
    better, one = judged("cubic_spring@a", 31.0, doubt), judged("cubic_spring@b", 30.0)
    better.linearisation, better.needed, one.linearisation = 17.0, needed, linearisation
    assert rounds._one_of_many(one, [better, one]) is passes_by_chance
    assert rounds._against(one, [better, one], -np.inf) == (BETTER_DOUBTED if passes_by_chance else "")
    assert rounds._against(one, [better, one], 31.0) == BETTER_CONTRADICTED


def test_a_round_judges_the_finalists_best_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "replace", replaced)
    ranked = [SimpleNamespace(gain=g, final=g < 5.0) for g in (1.0, 9.0, 4.0, 2.0)]
    told = {NOTHING: 0.1}
    monkeypatch.setattr(rounds, "_with_relief", lambda o, ranking, settings: ranking)
    monkeypatch.setattr(rounds, "_at_usual_scatters", lambda o, ranking, settings: ranking)
    monkeypatch.setattr(
        rounds,
        "probabilities",
        lambda ranking, hypotheses, settings, found, *believed: told | {"n": found},
    )
    monkeypatch.setattr(
        rounds,
        "judge",
        lambda o, ranking, r, settings, nothing, better: SimpleNamespace(
            gain=r.gain,
            better=[j.gain for j in better],
            nothing=nothing,
            doubt="",
            claimed=True,
            contradicted=False,
            believed=r.gain,
            linearisation=0.0,
            named=SimpleNamespace(label=""),
        ),
    )
    given: Any = SimpleNamespace(ranked=ranked, linearised=False)
    data: Any = None
    found = rounds.round_of(data, given, [], SETTINGS, 2)
    assert [(j.gain, j.nothing) for j in found.judged] == [(4.0, 0.1), (2.0, 0.1), (1.0, 0.1)]  # type: ignore[attr-defined]
    assert [len(j.better) for j in found.judged] == [0, 1, 2]  # type: ignore[attr-defined]
    assert found.probabilities == told | {"n": 2}
    assert found.ranking is given


@pytest.mark.parametrize(
    ("doubt", "behind", "claimed"),
    [
        (PREDICTED_WORSE, 13.0, False),
        (NO_LESS_ERROR, 13.0, False),
        (PREDICTED_WORSE, 2.9, True),  # as good as the better one
        ("the shape of one closely spaced mode", 13.0, True),  # which was no evidence
    ],
)
def test_nothing_is_claimed_far_behind_what_held_out_data_contradict(
    monkeypatch: pytest.MonkeyPatch, doubt: str, behind: float, claimed: bool
) -> None:
    one, other = judged_round(monkeypatch, [("better@x", 17.0, doubt), ("worse@x", 17.0 - behind, "")]).judged
    assert (one.gain, one.doubt) == (17.0, doubt)
    assert other.doubt == ("" if claimed else BETTER_CONTRADICTED)
    ahead = judged_round(monkeypatch, [("ahead@x", 30.0, ""), ("better@x", 17.0, doubt)])
    assert ahead.judged[0].claimed


@pytest.mark.parametrize(("left", "claimed"), [(9.0, True), (3.6, True), (3.5, False)])
def test_nothing_is_claimed_where_its_probability_without_doubtful_evidence_is_too_low(
    monkeypatch: pytest.MonkeyPatch, left: float, claimed: bool
) -> None:
    """Of a gain that rests on close modes only what is left counts, for the claim as for the probability."""
    prior = {"null_prior": 0.9}
    one = judged_round(monkeypatch, [("damper@x", 9.0, "")], left, SETTINGS.model_copy(update=prior))
    nothing = 0.9 / (0.9 + 0.1 * np.exp(left))
    assert one.probabilities[NOTHING] == pytest.approx(nothing)
    assert one.judged[0].claimed is claimed is bool(nothing <= SETTINGS.doubt)
    told = "the probability that no effect of the library is missing, 21 %, is above 20 %, and without what "
    assert one.judged[0].doubt.startswith(told) is not claimed
    assert one.judged[0].doubt.endswith("drops to 3.5") is not claimed


def judged_round(
    monkeypatch: pytest.MonkeyPatch,
    found: list[tuple[str, float, str]],
    left: float | Mapping[str, float] = np.inf,
    settings: DiagnoseSettings = SETTINGS,
) -> Round:
    """A round of hypotheses with what they gain, what speaks against them, and what is left without close modes."""
    left_of = left if isinstance(left, Mapping) else dict.fromkeys((label for label, _, _ in found), left)
    doubts = {label: doubt for label, _, doubt in found}
    names = {label: SimpleNamespace(label=label, advantage=0.0) for label, _, _ in found}
    fit: Any = None
    asked: list[Any] = [SimpleNamespace(label=n, generic=False) for n, _, _ in found]
    told = [Ranked(h, fit, gain, True) for h, (_, gain, _) in zip(asked, found, strict=True)]
    monkeypatch.setattr(rounds, "_with_relief", lambda o, ranking, settings: ranking)
    monkeypatch.setattr(rounds, "_at_usual_scatters", lambda o, ranking, settings: ranking)
    monkeypatch.setattr(probability, "named", lambda hypothesis, fit: names[hypothesis.label])
    monkeypatch.setattr(
        rounds,
        "judge",
        lambda o, ranking, r, settings, nothing, better: Judged(
            r,
            names[r.hypothesis.label],
            r.gain,
            fit,
            fit,
            fit,
            fit,
            doubts[r.hypothesis.label],
            3.5,  # type: ignore[arg-type]
            left_of[r.hypothesis.label],
        ),
    )
    data: Any = None
    return rounds.round_of(data, Ranking(fit, tuple(told)), asked, settings, 0)


def test_one_of_two_effects_counts_with_what_both_gain_though_the_other_one_is_contradicted_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A spring that gains 66 and a mass of 28, whose part stands out without it: neither was claimed."""
    found = judged_round(monkeypatch, [("spring@x", 66.0, NO_LESS_ERROR), ("mass@x", 28.0, "weak")])
    spring, mass = found.judged
    asked = [spring.hypothesis, mass.hypothesis]
    told = selection._acquitted(found, mass, dataclasses.replace(spring, gain=72.0), asked, SETTINGS, 0)
    assert [(j.hypothesis.label, j.gain, j.claimed) for j in told.judged] == [
        ("mass@x", 72.0, True),
        ("spring@x", 66.0, False),
    ]
    assert told.probabilities["mass@x"] > 0.999


def test_what_a_claim_gains_from_close_modes_counts_among_rivals_and_not_against_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A spring that gained 178, 161 without close modes, was claimed beside one of 171 that had 81 %."""
    gains = [("spring@x", 12.0, ""), ("spring@y", 8.0, ""), ("mass@x", 11.0, "weak")]
    told = judged_round(
        monkeypatch, gains, {"spring@x": 5.0, "spring@y": np.inf, "mass@x": 1.0}
    ).probabilities
    prior = 0.7 / 3
    beside = prior * (np.exp(5.0) + np.exp(8.0) + np.exp(1.0))
    assert told[NOTHING] == pytest.approx(0.3 / (0.3 + beside))
    among = np.exp(12.0) + np.exp(8.0) + np.exp(1.0)
    for name, gain in (("spring@x", 12.0), ("spring@y", 8.0), ("mass@x", 1.0)):
        assert told[name] == pytest.approx((1 - told[NOTHING]) * np.exp(gain) / among)


@pytest.mark.parametrize("doubt", [PREDICTED_WORSE, NO_LESS_ERROR])
def test_what_is_contradicted_is_not_probable_and_neither_is_what_lies_far_behind_it(
    monkeypatch: pytest.MonkeyPatch, doubt: str
) -> None:
    found = [("support@sun", 60.0, doubt), ("support@ring", 50.0, ""), ("mass@sun", -2.0, "weak")]
    told = judged_round(monkeypatch, found).probabilities
    prior = 0.7 / 3
    assert sum(told.values()) == pytest.approx(1.0)
    total = 0.3 + prior * (2 + np.exp(-2.0))
    assert told[NOTHING] == pytest.approx(0.3 / total)
    assert told["support@sun"] == told["support@ring"] == pytest.approx(prior / total)
    assert told["mass@sun"] == pytest.approx(prior * np.exp(-2.0) / total)


def test_what_is_contradicted_takes_nothing_from_what_is_ahead_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [("mass@sun", 30.0, ""), ("support@sun", 20.0, PREDICTED_WORSE)]
    told = judged_round(monkeypatch, found).probabilities
    assert told["mass@sun"] > 0.999
    found = [("gyroscopic@sun", 60.0, f"{MAY_BE_ZERO} 2 standard deviations of zero"), ("mass@sun", 20.0, "")]
    one = judged_round(monkeypatch, found)
    assert one.probabilities["mass@sun"] > 0.999
    assert one.best is not None
    found = [("support@sun", 21.0, PREDICTED_WORSE), ("mass@sun", 20.0, "")]  # as good
    told = judged_round(monkeypatch, found).probabilities
    assert told["mass@sun"] > 0.999


def test_no_more_effects_are_added_than_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = judged("a@x", 20.0, linear=False), judged("b@x", 9.0)
    steps = Steps(monkeypatch, [[a], [b]])
    found = steps.select([a.hypothesis, b.hypothesis], SETTINGS.model_copy(update={"most_effects": 1}), [])
    assert found.claimed == (a,)
    assert len(found.rounds) == 2
    told = _ended(found, SETTINGS.model_copy(update={"most_effects": 1}))
    assert told == "the limit of 1 automatically added effects is reached (`most_effects`)"
    assert [claim for _, claim, _ in steps.shares] == [3.5, 3.5]  # not linearised


# --- what of it is told --------------------------------------------------------------------------------------------


def selected(claimed: list[Any], *rounds: Round) -> Selection:
    nothing: Any = None
    alike_claims = tuple(of.alike(SETTINGS) for _, of in zip(claimed, rounds, strict=False))
    final: Any = claimed[-1].ranked.fit if claimed else None
    return Selection(tuple(rounds), tuple(claimed), final, nothing, alike_claims)


def test_how_the_search_ended() -> None:
    weak = judged("spring@m2", 1.0, "it gains little")
    assert (
        _ended(selected([], a_round(judged("x@y", 9.0)), a_round()), SETTINGS) == "no further effect to try"
    )
    told = _ended(selected([], a_round(weak, judged("x@y", 0.0, "none"))), SETTINGS)
    assert told == "the best further effect is spring at m2, and it gains little"


def test_candidates_are_the_claimed_ones_with_final_sizes_then_the_group_then_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Beside one of the group the size of another claim differs: it is averaged over the group."""
    a, b = judged("a@x", 20.0), judged("b@x", 9.0)
    alike, rest = judged("c@x", 7.0, "held-out"), judged("d@x", 8.0, "weak")
    first = a_round(a, told={"a@x": 0.9, "b@x": 0.05})
    second = a_round(b, rest, alike, judged("a@x", 1.0, "again"), told={"b@x": 0.8, "c@x": 0.15, "d@x": 0.01})
    third = a_round(judged("e@x", 1.0, "none"), told={"e@x": 0.1})
    final = {"a@x.size": EffectSize(5.0, 0.5, "N"), "b@x.size": EffectSize(6.0, 0.6, "N")}
    hypotheses: Any = [j.hypothesis for j in (a, b, alike, rest)]

    def sizes_of(of: object, name: object, fit: object) -> dict[str, EffectSize]:
        assert (of, fit) == (a.hypothesis, alike.ranked.fit)
        return {"size": EffectSize(7.0, 0.3, "N")}

    monkeypatch.setattr(diagnosis, "sizes_of", sizes_of)
    share = 1 / (1 + np.exp(2.0))  # two behind in log evidence
    found = _candidates(selected([a, b], first, second, third), SETTINGS, (b, alike), hypotheses, final)
    assert [(c.label, c.claimed, c.probability) for c in found] == [
        ("a@x", True, pytest.approx(0.9 / 0.95)), ("b@x", True, 0.8), ("c@x", False, 0.15), ("d@x", False, 0.01)
    ]  # fmt: skip
    assert [c.parameters["size"].value for c in found] == [pytest.approx(5.0 + 2.0 * share), 6.0, 7.0, 8.0]
    spread = (1 - share) * 0.5**2 + share * 0.3**2 + share * (1 - share) * 2.0**2
    assert found[0].parameters["size"].std == pytest.approx(np.sqrt(spread))
    assert found[0].why == "Its signs: signs."
    assert found[2].why == "Not claimed: held-out."
    one = found[1]
    assert (one.error_before, one.error_after, one.heldout_error_before, one.heldout_error_after) == (
        2.0,
        1.0,
        3.0,
        1.5,
    )
    assert (one.log_evidence, one.threshold, one.title) == (9.0, 3.5, "title of b@x")
    few = SETTINGS.model_copy(update={"candidates": 1})
    four = _candidates(selected([a, b], first, second, third), few, (b, alike), hypotheses, final)
    assert len(four) == 4
    assert len(_candidates(selected([a, b], first, second, third), few, (), hypotheses, final)) == 2


def test_what_explains_the_data_in_the_place_of_an_early_claim_shares_its_probability(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In its own round it was far behind; with its size from there it would be told wrongly."""
    a, b = judged("a@x", 20.0), judged("b@x", 9.0)
    instead = judged("c@x", 7.0)  # judged anew, beside b: two behind in log evidence
    first, second = a_round(a, judged("c@x", 1.0, "far"), told={"a@x": 0.99}), a_round(b, told={"b@x": 0.9})
    monkeypatch.setattr(diagnosis, "sizes_of", lambda of, name, fit: {"size": EffectSize(9.0, 0.1, "N")})
    hypotheses: Any = [j.hypothesis for j in (a, b, instead)]
    found = _candidates(selected([a, b], first, second), SETTINGS, (a, instead), hypotheses, {})
    told = 0.99 / np.array([1 + np.exp(-2.0), 1 + np.exp(2.0)])
    assert [(c.label, c.claimed) for c in found] == [("a@x", True), ("b@x", True), ("c@x", False)]
    assert [c.probability for c in found] == pytest.approx([told[0], 0.9, told[1]])
    assert found[2].parameters["size"].value == 7.0


def test_what_took_the_place_of_the_first_leader_has_its_probability() -> None:
    leader, spring = judged("mass@all", 20.0), judged("spring@q3", 9.0)
    first = a_round(leader, spring, told={"mass@all": 0.9, "spring@q3": 0.05})
    assert _first_probabilities(selected([spring], first)) == {"spring@q3": pytest.approx(0.95)}
    assert _first_probabilities(selected([leader], first)) == {"mass@all": 0.9, "spring@q3": 0.05}
    assert _first_probabilities(selected([], first)) == {"mass@all": 0.9, "spring@q3": 0.05}


def test_without_a_claim_the_candidates_are_those_of_the_first_round() -> None:
    one = a_round(judged("a@x", 2.0, "weak"), judged("b@x", 1.0, "weak"), told={"a@x": 0.2})
    found = _candidates(selected([], one), SETTINGS, (), [], {})
    assert [(c.label, c.probability) for c in found] == [("a@x", 0.2), ("b@x", 0.0)]
    assert len(_candidates(selected([], one), SETTINGS.model_copy(update={"candidates": 1}), (), [], {})) == 1


def test_what_else_is_claimed_is_no_alternative_to_a_claim() -> None:
    """The second effect alone gained more than the first one, and is certain beside it: neither is improbable."""
    a, b = judged("a@x", 1657.0), judged("b@x", 2925.0)
    first, second = a_round(a, told={"a@x": 0.0, "b@x": 1.0}), a_round(b, told={"b@x": 1.0})
    found = _candidates(selected([a, b], first, second), SETTINGS, (), [a.hypothesis, b.hypothesis], {})
    assert [(c.label, c.probability) for c in found] == [("a@x", 1.0), ("b@x", 1.0)]


def test_a_claim_that_took_the_place_of_an_earlier_one_has_a_probability_of_its_own() -> None:
    """Against nothing alone, by its prior: it was no finalist of that round."""
    late = judged("a@x", 10.0)
    own: Any = SimpleNamespace(generic=False)
    found = _candidates(
        selected([late], a_round(judged("b@x", 5.0))), SETTINGS, (), [late.hypothesis, own], {}
    )
    odds = np.exp(10.0) * (1 - SETTINGS.null_prior) / 2 / SETTINGS.null_prior
    assert found[0].probability == pytest.approx(odds / (1 + odds), rel=1e-3)


def test_a_part_out_of_tolerance_stands_beside_a_generic_effect_as_likely() -> None:
    """One of the rig's own effects alone makes generic ones its equivalents."""
    generic, part = judged("damper@m1", 8.0, generic=True), judged("out_of_tolerance@k1", 7.0, specific=False)
    own = judged("sensor_mass@m1", 6.0)
    alone, beside = a_round(generic, part), a_round(generic, part, own)
    assert labels(alike(selected([generic], alone))) == ["damper@m1", "out_of_tolerance@k1"]
    assert labels(alike(selected([generic], beside))) == ["sensor_mass@m1", "out_of_tolerance@k1"]


def test_groups_are_rivals_and_names_of_one_each_told_once() -> None:
    a, b = judged("a@x", 20.0, equivalents=("a@z",)), judged("b@x", 9.0)
    rival, generic = judged("c@x", 8.0), judged("s@x", 19.0, generic=True)
    rounds = a_round(a, generic), a_round(b, rival), a_round()
    found = selected([a, b], *rounds)
    assert _groups(found, (b, rival)) == (("b@x", "c@x"), ("a@x", "a@z", "s@x"))
    assert _groups(found, ()) == (("a@x", "a@z", "s@x"), ("b@x", "c@x"))
    assert _groups(selected([b], a_round(b)), ()) == ()
    assert _groups(selected([b], a_round(b)), (b,)) == ()
