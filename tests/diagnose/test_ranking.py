"""Which hypotheses are fitted, from where, and how they are ranked: on fits written down by hand."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from written_fits import NO_DATA, Parabola, fit, hypothesis, law, score, with_model

from ema_pipeline.diagnose import ranking
from ema_pipeline.diagnose.first_fits import Tried
from ema_pipeline.diagnose.ranking import (
    Found,
    Ranked,
    Ranking,
    _batches,
    _begun_again,
    _better,
    _bettered,
    _contenders,
    _crossed,
    _decides,
    _finals,
    _on,
    _pairing,
    _promising,
    _screened,
    _with_promising,
)
from ema_pipeline.inference import Scatter
from ema_pipeline.observations.fitting import Fit
from ema_pipeline.observations.mode_rows import SHAPE


def test_where_the_base_model_fails_laws_in_time_are_screened_among_themselves() -> None:
    linear = [hypothesis(f"linear{k}", generic=True) for k in range(14)]
    laws = [law(f"law{k}") for k in range(26)]
    promise = {h.label: score(30.0 - k) for k, h in enumerate([*linear, *laws])}
    assert _screened([*linear, *laws], promise, near=False) == [*linear, *laws[:24]]
    assert _screened([*linear, *laws], promise, near=True) == linear


def test_of_many_hypotheses_those_of_each_kind_are_fitted_that_promise_most() -> None:
    own = [hypothesis(f"own{k}") for k in range(16)]
    generic = [hypothesis(f"generic{k}", generic=True) for k in range(16)]
    others = [hypothesis("two sizes", sizes=2), hypothesis("not scored", generic=True)]
    everything = [*own, *others, *generic]
    promise = {h.label: score(float(k)) for k, h in enumerate(own)}
    promise |= {h.label: score(-3.0 if k < 4 else 0.5) for k, h in enumerate(generic)}
    promise["generic9"] = score(0.999)
    promise["generic10"] = score(1.0)
    promise["two sizes"] = score(-100.0)
    far = _screened(everything, promise, near=False)
    assert far == [*own, *others, *[h for h in generic if h.label not in ("generic2", "generic3")]]
    near = [h.label for h in _screened(everything, promise, near=True)]
    assert near[:16] == [*(f"own{k}" for k in range(2, 16)), "two sizes", "not scored"]
    assert near[16:] == [f"generic{k}" for k in (4, 5, 6, 7, 9, 10)]
    promise |= {h.label: score(1.0) for h in generic[4:]}
    assert len(_screened(everything, promise, near=True)) == 16 + 12


# --- the order of fits ---------------------------------------------------------------------------------------------


def found_of(**values: float) -> Found:
    return {name: (hypothesis(name), fit(name, value)) for name, value in values.items()}


def test_finalists_are_learned_and_compared_with_the_learned_base(monkeypatch: pytest.MonkeyPatch) -> None:
    learned: list[tuple[str, bool]] = []
    crossed: list[str] = []
    among: set[tuple[str, ...]] = set()

    def learn(observations: object, past_barriers: bool, one: Any) -> Any:
        learned.append((one.model.name, past_barriers))
        return SimpleNamespace(log_evidence=one.log_evidence + (30.0 if one.model.name == "b" else 3.0))

    def cross(observations: object, sources: Any, one: Any) -> Any:
        crossed.append(one.model.name)
        among.add(tuple(s.model.name for s in sources))
        return SimpleNamespace(log_evidence=one.log_evidence + (1.0 if one.model.name == "base" else 0.0))

    monkeypatch.setattr(ranking, "_learned", learn)
    monkeypatch.setattr(ranking, "_crossed", cross)
    found = found_of(a=60.0, b=50.0, c=-139.0, d=-140.0, e=-141.0, f=-150.0, g=-200.0)
    promising = [(hypothesis("g"), fit("g", 20.0))]
    told = _finals(NO_DATA, fit("base", 10.0), list(found.values()), promising, 1, (), True)
    asked = [(name, True) for name in ("base", "a", "b", "c", "d", "g")]
    assert learned == [*asked, ("e", False)]  # e can no longer catch up
    assert crossed == ["base", "a", "b", "c", "d", "g"]
    assert among == {("base", "b", "a")}
    assert told.base.log_evidence == 14.0
    gains = {r.hypothesis.label: (r.gain, r.final) for r in told.ranked}
    assert list(gains) == ["b", "a", "g", "c", "d", "e", "f"]
    assert gains["b"] == (50.0 + 30.0 - 14.0, True)
    assert gains["g"] == (9.0, True)
    assert gains["e"] == (-141.0 + 3.0 - 14.0, True)
    assert gains["f"] == (-160.0, False)
    close = list(found_of(a=13.0, b=12.8, c=12.6, d=12.4, e=12.0, f=11.5).values())
    told = _finals(NO_DATA, fit("base", 10.0), close, [], 1, (), True)
    last = told.ranked[-1]  # at wide scatters ahead of nothing by 1.5, no finalist by 1
    assert (last.hypothesis.label, last.gain) == ("f", told.ranked[-2].gain) == ("f", 1.0)
    assert _finals(NO_DATA, fit("base", 10.0), [], [], 1, (), True).ranked == ()


def test_beside_a_base_model_that_explains_the_data_nothing_is_led_past_its_barriers_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learned: list[tuple[str, bool]] = []

    def learn(observations: object, past_barriers: bool, one: Any) -> Any:
        learned.append((one.model.name, past_barriers))
        return SimpleNamespace(log_evidence=one.log_evidence + 100.0)

    monkeypatch.setattr(ranking, "_learned", learn)
    monkeypatch.setattr(ranking, "_crossed", lambda o, sources, one: one.posterior)
    order = list(found_of(a=12.0, b=11.9, c=11.8, d=11.7, e=11.6, f=11.5).values())
    known = [fit("settled", 111.0), fit("narrow", 110.0)]
    told = _finals(NO_DATA, fit("base", 10.0), order, [], 1, known, False)
    assert learned == [(name, False) for name in "abcde"]
    assert told.base.log_evidence == 111.0
    # what is no finalist is held against the base model at the same wide scatters
    assert [round(r.gain, 1) for r in told.ranked] == [1.0, 0.9, 0.8, 0.7, 0.6, 0.6]


def test_what_modes_without_a_partner_cost_is_the_least_over_all() -> None:
    def ranked(penalty: float) -> Ranked:
        residuals = SimpleNamespace(penalty=penalty)
        return Ranked(hypothesis("a"), fit("a", 0.0, residuals=residuals), 0.0, True)

    assert Ranking(fit("base", 0.0), (ranked(3.0), ranked(1.0), ranked(2.0))).unpaired == 1.0
    assert Ranking(fit("base", 0.0), ()).unpaired == 0.0


def test_only_the_best_are_bettered() -> None:
    found = found_of(a=1.0, b=3.0, c=2.0)
    told = _bettered(found, ["b", "c"], lambda one: fit("x", one.log_evidence + 10.0).posterior, 1)
    assert {k: f.log_evidence for k, (_, f) in told.items()} == {"a": 1.0, "b": 13.0, "c": 12.0}
    assert [f.model.name for _, f in told.values()] == ["a", "b", "c"]  # type: ignore[attr-defined]


def test_what_is_far_behind_is_no_contender() -> None:
    far = {f"h{k}": 0.0 - k for k in range(20)} | {"best": 195.0}
    assert _contenders(found_of(**far)) == ["best", *(f"h{k}" for k in range(6))]
    assert _contenders(found_of(**{k: v - 100 for k, v in far.items() if k != "best"})) == [
        f"h{k}" for k in range(12)
    ]
    assert _contenders({}) == []


def test_what_promises_most_is_fitted_first_and_the_rest_in_a_few_steps_once_all_is_explained() -> None:
    everything = [hypothesis(f"h{k}") for k in range(40)]
    more = [hypothesis("two sizes", sizes=2), hypothesis("not scored")]
    promise: Any = {h.label: score(float(k)) for k, h in enumerate(everything)} | {"two sizes": score(-9.0)}
    first, rest = _batches([*everything, *more], promise, ())
    assert [h.label for h in first] == [*(f"h{k}" for k in range(16, 40)), "two sizes", "not scored"]
    assert [h.label for h in rest] == [f"h{k}" for k in range(16)]
    assert _batches(everything, {}, ()) == [everything, []]
    first, _ = _batches(everything, promise, {"h3"})
    assert [h.label for h in first] == ["h3", *(f"h{k}" for k in range(16, 40))]


def test_what_gives_a_lost_mode_a_partner_is_fitted_though_its_score_promises_nothing() -> None:
    tried = {f"h{k}": Tried(8.0, float(k)) for k in range(20)}
    assert _pairing(tried) == {f"h{k}" for k in range(12, 20)}


def test_the_search_ends_where_one_hypothesis_explains_all() -> None:
    base = fit("base", 0.0)
    for evidence, error, decided in ((201.0, 0.49, True), (200.0, 0.49, False), (201.0, 0.5, False)):
        found: Any = SimpleNamespace(log_evidence=evidence, error=error)
        assert _decides(found, base) is decided


def test_the_base_and_the_best_begin_again_at_what_the_best_of_all_knows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    starts: list[Any] = []

    def refined(observations: object, model: Any, x: Any, steps: int = 12) -> Fit:
        starts.append((model.name, x, steps))
        return fit(model.name, 11.0)

    monkeypatch.setattr(ranking, "refined", refined)
    monkeypatch.setattr(
        ranking, "_on", lambda o, model, source, sizes: f"{sizes.model.name} at {source.model.name}"
    )
    monkeypatch.setattr(
        ranking,
        "_better",
        lambda o, sources, steps, one: SimpleNamespace(
            log_evidence=one.log_evidence + 1.0,
            of=(*(s.model.name for s in sources), sources[0].log_evidence, steps),
        ),
    )
    base, found = _begun_again(NO_DATA, fit("base", 10.0), found_of(a=1.0, b=3.0), 1, ["b"], steps=7)
    assert starts == [("base", "base at b", 20)]
    assert base.log_evidence == 11.0
    assert {k: f.log_evidence for k, (_, f) in found.items()} == {"a": 1.0, "b": 4.0}
    assert found["b"][1].posterior.of == ("base", "b", 11.0, 7)  # type: ignore[attr-defined]
    better, _ = _begun_again(NO_DATA, fit("base", 12.0), found_of(a=1.0), 1, ["a"], steps=7)
    assert better.log_evidence == 12.0


def test_what_another_fit_knows_is_taken_over_but_for_the_sizes() -> None:
    mine = with_model("a", Parabola(("part", "common", "a.s"), ("a.s",)), [0.1, 0.2, 0.3])
    other = with_model("b", Parabola(("part", "a.s", "b.s"), ("a.s", "b.s")), [0.7, 0.8, 0.9])
    np.testing.assert_array_equal(_on(NO_DATA, mine.model, other, mine), [0.7, 0.2, 0.3])
    new = with_model("c", Parabola(("part", "b.s"), ("b.s",)), [0.0, 0.0])
    np.testing.assert_array_equal(
        _on(NO_DATA, new.model, other, mine), [0.7, 0.9]
    )  # nobody else knows that size


def test_a_better_fit_is_kept_and_the_same_start_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = with_model("a", Parabola(("part", "a.s"), ("a.s",)), [0.1, 0.3], 5.0)
    sources = [with_model("b", Parabola(("part",), ()), [v]) for v in (0.1, 0.5, 0.7)]
    tried = []

    def refined(observations: object, model: Any, x: np.ndarray, steps: int) -> Fit:
        tried.append((x.tolist(), steps))
        return with_model("a", Parabola(("part", "a.s"), ("a.s",)), x.tolist(), 10.0 * (1.2 - x[0]))

    monkeypatch.setattr(ranking, "refined", refined)
    best = _better(NO_DATA, sources, 4, mine)
    assert tried == [([0.5, 0.3], 4), ([0.7, 0.3], 4)]
    assert best.x.tolist() == [0.5, 0.3]


def test_scatters_are_learned_again_where_another_start_leads_further(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mine = with_model("a", Parabola(("part", "a.s"), ("a.s",)), [0.1, 0.3], 5.0)
    there, elsewhere = (with_model("b", Parabola(("part",), ()), [v]) for v in (0.5, 0.7))

    def refined(observations: object, model: Any, x: np.ndarray, scatters: object, steps: int) -> Fit:
        reached = {(0.5, 10): 6.0, (0.7, 10): 6.04, (0.1, 4): 6.0}
        return with_model("a", Parabola(("part", "a.s"), ("a.s",)), x.tolist(), reached[x[0], steps])

    def learned(observations: object, one: Fit, past_barriers: bool) -> Fit:
        assert not past_barriers
        asked.append(float(one.posterior.x[0]))
        return with_model("a", Parabola(("part", "a.s"), ("a.s",)), one.posterior.x.tolist(), value)

    monkeypatch.setattr(ranking, "refined", refined)
    monkeypatch.setattr(ranking, "learned", learned)
    asked: list[float] = []
    value = 9.0
    assert _crossed(NO_DATA, [mine, there, elsewhere], mine) is mine.posterior
    assert asked == []  # neither leads further by as much as is worth it
    monkeypatch.setattr(ranking, "_BETTER", 0.03)
    assert _crossed(NO_DATA, [mine, there, elsewhere], mine).log_evidence == 9.0
    assert asked == [0.7]
    value = 4.0
    assert _crossed(NO_DATA, [elsewhere], mine) is mine.posterior


def test_what_promises_most_beside_learned_scatters_begins_at_its_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settled = with_model("base", Parabola(("part",), ()), [0.4])
    names = {k: (f"{k}.s1",) for k in "abc"}
    models = {k: with_model(k, Parabola(("part", *names[k]), names[k]), [0.0, 0.0]).model for k in "abc"}
    told = {"a": (1.0, 0.1), "b": (3.0, 0.2), "c": (2.0, 9.0)}

    def scores(
        observations: object, fit: object, hypotheses: Any, models: object, processes: int
    ) -> list[Any]:
        return [
            SimpleNamespace(hypothesis=h, gain=told[h.label][0], size=np.array([told[h.label][1]]))
            for h in hypotheses
        ]

    monkeypatch.setattr(ranking, "scores", scores)
    monkeypatch.setattr(ranking, "refined", lambda o, model, x, scatters: (model.name, x.tolist(), scatters))
    asked = [hypothesis(k) for k in "abc"]
    found: Any = _promising(NO_DATA, settled, asked, models, 2, 1)
    assert [(h.label, f) for h, f in found] == [
        ("b", ("b", [0.4, 0.2], {"part": 1.0})),
        ("c", ("c", [0.4, 1.9], {"part": 1.0})),
    ]
    told = {"a": (1.0, 0.1), "b": (1.1, 0.2), "c": (-2.0, 9.0)}
    promised = [h.label for h, _ in _promising(NO_DATA, settled, asked, models, 0, 1)]
    assert promised == ["b"]  # a promises no more than what is next to nothing
    assert [h.label for h, _ in _promising(NO_DATA, settled, asked, models, 2, 1)] == ["b", "a"]
    told = dict.fromkeys("abcde", (5.0, 0.1))
    names |= {k: (f"{k}.s1",) for k in "de"}
    models |= {k: with_model(k, Parabola(("part", *names[k]), names[k]), [0.0, 0.0]).model for k in "de"}
    everything = [hypothesis(k) for k in "abcde"]
    assert len(_promising(NO_DATA, settled, everything, models, 0, 1)) == 3
    assert len(_promising(NO_DATA, settled, everything, models, 4, 1)) == 4


@pytest.mark.parametrize(
    ("evidence", "bent", "added"), [(4.1, False, True), (3.9, False, False), (4.1, True, False)]
)
def test_what_was_behind_at_wide_scatters_and_gains_beside_learned_ones_is_a_finalist(
    monkeypatch: pytest.MonkeyPatch, evidence: float, bent: bool, added: bool
) -> None:
    wide, base, more = fit("wide", 9.0), fit("base", 3.0), fit("b", evidence)
    first = Ranking(
        base,
        (
            Ranked(hypothesis("a"), fit("a", 1.0), -2.0, True),
            Ranked(hypothesis("c"), fit("c", 0.0), -3.0, False),
        ),
    )
    asked: list[Any] = []

    def promising(o: object, settled: Fit, others: Any, models: object, count: int, processes: object) -> Any:
        asked.append((settled, [h.label for h in others], count))
        return [(others[0], more)]

    def finals(
        o: object, now: Fit, order: Any, found: Any, processes: object, known: Any, past_barriers: bool
    ) -> Any:
        return now, [h.label for h, _ in order], found, known, past_barriers

    monkeypatch.setattr(ranking, "unbent", lambda o, one: not bent)
    monkeypatch.setattr(ranking, "_promising", promising)
    monkeypatch.setattr(ranking, "_finals", finals)
    b, c = hypothesis("b"), first.ranked[1].hypothesis
    found: Any = _with_promising(NO_DATA, wide, first, [first.ranked[0].hypothesis, b, c], {}, 1)
    if not added:
        assert found is first
        return
    assert asked == [(base, ["b", "c"], 0)]
    assert found == (wide, ["a", "c"], [(b, more)], (base,), False)


# --- all of it -----------------------------------------------------------------------------------------------------


class Stages:
    """Stands for every stage of `rank`, and keeps what it was asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, bent: bool = False) -> None:
        self.asked: list[Any] = []
        self.short = False
        labels = ("a", "b", "c", "d", "e", "f", "unseen")
        self.hypotheses = [hypothesis(k) for k in labels]
        stds = dict.fromkeys(labels, 9e5) | {"unseen": 1e6}
        told = [
            SimpleNamespace(hypothesis=h, std=stds[h.label], gain=0.0)
            for h in self.hypotheses
            if h.label != "f"
        ]
        monkeypatch.setattr(ranking, "scores", lambda *given: told)
        monkeypatch.setattr(ranking, "learned", lambda o, one, past_barriers=True: fit("learned", 0.0))
        monkeypatch.setattr(ranking, "_narrowed", lambda o, settled: None)
        monkeypatch.setattr(ranking, "unbent", lambda o, one: not bent)
        monkeypatch.setattr(ranking, "tried_sizes", self.tried_sizes)
        monkeypatch.setattr(ranking, "_screened", self.screened)
        monkeypatch.setattr(ranking, "short_fits", self.short_fits)
        monkeypatch.setattr(ranking, "first_fit", partial(self.first_fit, "first"))
        monkeypatch.setattr(
            ranking,
            "annealed_fit",
            lambda o, base, models, promise, tried, h: self.first_fit(
                f"annealed{len(tried)}", o, base, models, promise, h
            ),
        )
        monkeypatch.setattr(ranking, "_begun_again", self.begun_again)
        monkeypatch.setattr(ranking, "_bettered", self.bettered)
        monkeypatch.setattr(ranking, "_promising", self.promising)
        monkeypatch.setattr(
            ranking, "_with_promising", lambda o, base, found, hypotheses, models, processes: found
        )
        monkeypatch.setattr(
            ranking,
            "_finals",
            lambda o, base, order, promising, processes, known, past_barriers: (
                base,
                order,
                list(promising),
                [f.model.name for f in known] + ["past barriers"] * past_barriers,
            ),
        )
        for h in self.hypotheses:
            h.scales = {}
        self.base = fit("base", 0.0, error=1.3, residuals=SimpleNamespace(penalty=2.0, unexplained=1))
        self.base.model.plus = lambda placed, scales: placed.label  # type: ignore[attr-defined]

    def screened(self, hypotheses: Any, promise: Any, near: bool) -> Any:
        self.asked.append(("screened", [h.label for h in hypotheses], near))
        return hypotheses

    def tried_sizes(self, o: object, base: Any, models: Any, hypotheses: Any, processes: object) -> Any:
        assert [h.label for h in hypotheses] == [h.label for h in self.hypotheses]
        return {"b": Tried(4.0, 9.0)}

    def short_fits(self, *given: object) -> list[tuple[Any, Any]]:
        self.short = True
        return []

    def first_fit(self, how: str, o: object, base: object, models: Any, promise: Any, h: Any) -> Any:
        self.asked.append((how, h.label, len(promise)))
        return SimpleNamespace(log_evidence=float("fedcba".index(h.label)), error=1.0)

    def begun_again(
        self, o: object, base: Any, found: Any, processes: object, contenders: Any, steps: int
    ) -> Any:
        self.asked.append(("again", len(contenders), steps))
        return base, found

    def bettered(self, found: Any, contenders: Any, job: Any, processes: object) -> Any:
        self.asked.append(("freed", len(contenders)))
        return found

    def promising(
        self, o: object, settled: Any, others: Any, models: Any, further: int, processes: object
    ) -> Any:
        self.asked.append(("promising", settled.model.name, [h.label for h in others], further))
        return ["more"]

    def rank(self, base: Fit, **given: Any) -> Any:
        told: list[tuple[float, str]] = []
        found = ranking.rank(
            NO_DATA, base, self.hypotheses, progress=lambda share, text: told.append((share, text)), **given
        )
        assert [share for share, _ in told] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8])
        return found


@pytest.mark.parametrize(
    ("unpaired", "unexplained", "annealed"), [(2.0, 1, "ef"), (1.9, 1, "bef"), (2.0, 2, "bef")]
)
def test_those_behind_in_short_fits_are_annealed_where_a_size_leads_modes_to_partners(
    monkeypatch: pytest.MonkeyPatch, unpaired: float, unexplained: int, annealed: str
) -> None:
    """A few steps do not. Modes that had no partner in an earlier round are looked for where they are several."""
    stages = Stages(monkeypatch)
    stages.base.posterior.residuals.unexplained = unexplained  # type: ignore[misc]
    stages.base.posterior.error = 1.31  # type: ignore[misc]
    best_first = [(h, SimpleNamespace(log_evidence=0.0, error=1.0)) for h in stages.hypotheses[-2::-1]]
    monkeypatch.setattr(ranking, "short_fits", lambda *given: best_first)
    monkeypatch.setattr(ranking, "_ANNEALED", 2)
    ranking.rank(NO_DATA, stages.base, stages.hypotheses, unpaired=unpaired)
    assert [asked[1] for asked in stages.asked if asked[0].startswith("annealed")] == list(annealed)


def test_near_the_base_model_scores_tell_where_fits_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stages(monkeypatch)
    base, order, promising, known = stages.rank(stages.base, further=2, unpaired=2.0)
    assert base is stages.base
    assert known == ["learned"]
    assert [h.label for h, _ in order] == ["a", "b", "c", "d", "e", "f"]
    assert promising == ["more"]
    assert stages.asked[0] == (
        "screened",
        ["a", "b", "c", "d", "e", "f"],
        True,
    )  # what cannot be seen is left out
    assert stages.asked[1] == ("first", "a", 6)
    assert stages.asked[7:] == [("freed", 6), ("again", 6, 12), ("promising", "learned", ["f"], 2)]


@pytest.mark.parametrize("bent", [False, True])
def test_what_promises_beside_narrow_shapes_is_a_finalist_whatever_was_one_before(
    monkeypatch: pytest.MonkeyPatch, bent: bool
) -> None:
    """What is missing may have been learned as scatter."""
    stages = Stages(monkeypatch, bent)
    monkeypatch.setattr(ranking, "_narrowed", lambda o, settled: fit("narrow", 0.0))
    _, _, promising, known = stages.rank(stages.base, further=2, unpaired=2.0)
    assert promising == ["more"] * (1 if bent else 2)
    assert stages.asked[-1] == ("promising", "narrow", ["a", "b", "c", "d", "e", "f"], 0)
    assert known == (["learned", "past barriers"] if bent else ["learned", "learned"])


def test_the_scatter_of_shapes_is_narrowed_half_the_way_where_something_may_have_been_learned_as_scatter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shape = Scatter(SHAPE, "shapes", 0.015, 0.5, 0.03, 1.5, 0.03)
    other = Scatter("part", "parts", 0.02)
    data: Any = SimpleNamespace(scatters={s.name: s for s in (shape, other)})
    monkeypatch.setattr(ranking, "refined", lambda o, model, x, scatters: scatters)
    wide: Any = SimpleNamespace(model="base", posterior=SimpleNamespace(x=0))
    wide.posterior.scatters = {SHAPE: 0.0045, "part": 0.03}
    assert ranking._narrowed(data, wide) == pytest.approx({SHAPE: 0.0045 / np.sqrt(10), "part": 0.03})
    wide.posterior.scatters = {SHAPE: 0.0008, "part": 0.03}
    assert ranking._narrowed(data, wide) is None
    assert ranking._narrowed(SimpleNamespace(scatters={}), wide) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("error", "unpaired", "bent"), [(1.31, 2.0, False), (1.3, 1.9, False), (1.3, 2.0, True)]
)
def test_a_base_model_that_is_stuck_or_bent_is_begun_again_with_all(
    monkeypatch: pytest.MonkeyPatch, error: float, unpaired: float, bent: bool
) -> None:
    stages = Stages(monkeypatch, bent)
    stages.base.posterior.error = error  # type: ignore[misc]
    _, _, promising, known = stages.rank(stages.base, further=2, unpaired=unpaired)
    assert promising == []
    assert known == ["past barriers"]
    assert stages.asked[0][2] is False
    lost = unpaired < 2.0
    assert stages.asked[1] == ("first" if bent else f"annealed{int(lost)}", "a", 6)
    assert stages.short
    assert stages.asked[7:] == [("again", 6, 5), ("freed", 6), ("again", 6, 12)]
