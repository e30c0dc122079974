"""Which finalists there are, and how their scatters are learned: on fits written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from written_fits import NO_DATA, Parabola, fit, found_of, hypothesis, law, with_model

from ema_pipeline.diagnose import finals
from ema_pipeline.diagnose.finals import (
    _crossed,
    finals_of,
    known_from,
    leading,
    narrowed,
    promising_fits,
    with_promising,
)
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.inference import Scatter
from ema_pipeline.observations.fitting import Fit
from ema_pipeline.observations.mode_rows import SHAPE


def test_finalists_are_learned_and_compared_with_the_learned_base(monkeypatch: pytest.MonkeyPatch) -> None:
    learned: list[tuple[str, bool]] = []
    crossed: list[str] = []
    among: set[tuple[str, ...]] = set()

    def learn(observations: object, one: Any, past_barriers: bool) -> Any:
        learned.append((one.model.name, past_barriers))
        return fit(one.model.name, one.log_evidence + (30.0 if one.model.name == "b" else 3.0))

    def cross(observations: object, sources: Any, one: Any) -> Any:
        crossed.append(one.model.name)
        among.add(tuple(s.model.name for s in sources))
        return SimpleNamespace(log_evidence=one.log_evidence + (1.0 if one.model.name == "base" else 0.0))

    monkeypatch.setattr(finals, "learned", learn)
    monkeypatch.setattr(finals, "_crossed", cross)
    found = found_of(a=215.0, b=205.0, c=16.0, d=15.0, e=14.0, f=5.0, g=-45.0)
    promising = [(hypothesis("g"), fit("g", 20.0))]
    told = finals_of(NO_DATA, fit("base", 10.0), list(found.values()), promising, 1, (), True)
    asked = [(name, True) for name in ("base", "a", "b", "c", "d", "g")]
    assert learned == [*asked, ("e", False)]  # e can no longer catch up
    assert crossed == ["base", "a", "b", "c", "d", "g"]
    assert among == {("base", "b", "a")}
    assert told.base.log_evidence == 14.0
    gains = {r.hypothesis.label: (r.gain, r.final) for r in told.ranked}
    assert list(gains) == ["b", "a", "g", "c", "d", "e", "f"]
    assert gains["b"] == (205.0 + 30.0 - 14.0, True)
    assert gains["g"] == (9.0, True)
    assert gains["e"] == (14.0 + 3.0 - 14.0, True)
    assert gains["f"] == (-5.0, False)
    behind = list(found_of(a=15.0, b=12.8, c=12.6, d=12.4, e=12.0, f=11.5).values())
    told = finals_of(NO_DATA, fit("base", 10.0), behind, [], 1, (), True)
    last = told.ranked[-1]  # at wide scatters ahead of nothing by 1.5, no finalist by 1
    assert (last.hypothesis.label, last.gain) == ("f", told.ranked[-2].gain) == ("f", 1.0)
    assert not last.final
    assert finals_of(NO_DATA, fit("base", 10.0), [], [], 1, (), True).ranked == ()


def test_scatters_are_learned_of_three_and_of_what_gains_something(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finals, "learned", lambda o, one, past_barriers: one)
    monkeypatch.setattr(finals, "_crossed", lambda o, sources, one: one.posterior)
    for evidence, expected in ((10.0, "abc"), (8.05, "abcd")):
        order = list(found_of(a=9.0, b=8.5, c=8.2, d=8.1, e=8.0).values())
        told = finals_of(NO_DATA, fit("base", evidence), order, [], 1, (), True)
        assert [r.hypothesis.label for r in told.ranked if r.final] == list(expected)


def test_the_best_linear_effects_are_finalists_behind_however_many_laws() -> None:
    order = [(law(f"l{k}"), fit(f"l{k}", 90.0 - k)) for k in range(20)]
    order += [
        (hypothesis(name), fit(name, evidence)) for name, evidence in (("a", 40.0), ("b", 30.0), ("c", 20.0))
    ]
    found = [one.label for one, _ in leading(order, fit("base", 25.0))]
    assert found == ["l0", "l1", "l2", "l3", "l4", "a", "b"]
    found = [one.label for one, _ in leading(order, fit("base", 35.0))]
    assert found == ["l0", "l1", "l2", "l3", "l4", "a"]  # only what gains something
    assert len(leading(order[20:], fit("base", 25.0))) == 3  # and nothing twice


def test_what_may_be_as_good_as_the_best_is_a_finalist_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Springs between a sun and each of four planets that are alike: a group without some of them misleads."""
    monkeypatch.setattr(finals, "learned", lambda o, one, past_barriers: one)
    monkeypatch.setattr(finals, "_crossed", lambda o, sources, one: one.posterior)
    order = list(found_of(a=14.0, b=13.9, c=13.8, d=13.7, e=13.6, f=13.5, g=11.1, h=10.9).values())
    for base, expected in ((5.0, "abcdefg"), (12.6, "abcde"), (0.0, "abcdefg")):
        told = finals_of(NO_DATA, fit("base", base), order, [], 1, (), True)
        assert "".join(r.hypothesis.label for r in told.ranked if r.final) == expected
    many = list(found_of(**{f"x{k:02}": 14.0 for k in range(20)}).values())
    told = finals_of(NO_DATA, fit("base", 5.0), many, [], 1, (), True)
    assert sum(r.final for r in told.ranked) == 16


def test_beside_a_base_model_that_explains_the_data_nothing_is_led_past_its_barriers_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learned: list[tuple[str, bool]] = []

    def learn(observations: object, one: Any, past_barriers: bool) -> Any:
        learned.append((one.model.name, past_barriers))
        return fit(one.model.name, one.log_evidence + 100.0)

    monkeypatch.setattr(finals, "learned", learn)
    monkeypatch.setattr(finals, "_crossed", lambda o, sources, one: one.posterior)
    order = list(found_of(a=12.0, b=11.9, c=11.8, d=11.7, e=11.6, f=10.9).values())
    known = [fit("settled", 111.0), fit("narrow", 110.0)]
    told = finals_of(NO_DATA, fit("base", 10.0), order, [], 1, known, False)
    assert learned == [(name, False) for name in "abcde"]
    assert told.base.log_evidence == 111.0
    # what is no finalist is held against the base model at the same wide scatters
    assert [round(r.gain, 1) for r in told.ranked] == [1.0, 0.9, 0.8, 0.7, 0.6, 0.6]


def test_what_another_fit_knows_is_taken_over_but_for_the_sizes() -> None:
    mine = with_model("a", Parabola(("part", "common", "a.s"), ("a.s",)), [0.1, 0.2, 0.3])
    other = with_model("b", Parabola(("part", "a.s", "b.s"), ("a.s", "b.s")), [0.7, 0.8, 0.9])
    np.testing.assert_array_equal(known_from(NO_DATA, mine.model, other, mine), [0.7, 0.2, 0.3])
    new = with_model("c", Parabola(("part", "b.s"), ("b.s",)), [0.0, 0.0])
    np.testing.assert_array_equal(
        known_from(NO_DATA, new.model, other, mine), [0.7, 0.9]
    )  # nobody else knows that size


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

    monkeypatch.setattr(finals, "refined", refined)
    monkeypatch.setattr(finals, "learned", learned)
    asked: list[float] = []
    value = 9.0
    assert _crossed(NO_DATA, [mine, there, elsewhere], mine) is mine.posterior
    assert asked == []  # neither leads further by as much as is worth it
    monkeypatch.setattr(finals, "_BETTER", 0.03)
    assert _crossed(NO_DATA, [mine, there, elsewhere], mine).log_evidence == 9.0
    assert asked == [0.7]
    value = 4.0
    assert _crossed(NO_DATA, [elsewhere], mine) is mine.posterior
    # what has met it, at the same scatters, is no other start
    value, near = 9.0, with_model("b", Parabola(("part",), ()), [0.14])
    asked.clear()
    assert _crossed(NO_DATA, [near], mine) is mine.posterior
    near.posterior.scatters["part"] = 1.06
    monkeypatch.setattr(finals, "refined", lambda o, model, x, scatters, steps: fit("a", steps, x=x))
    monkeypatch.setattr(finals, "learned", lambda o, one, past_barriers: fit("a", 9.0))
    assert _crossed(NO_DATA, [near], mine).log_evidence == 9.0


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

    monkeypatch.setattr(finals, "scores", scores)
    monkeypatch.setattr(finals, "refined", lambda o, model, x, scatters: (model.name, x.tolist(), scatters))
    asked = [hypothesis(k) for k in "abc"]
    found: Any = promising_fits(NO_DATA, settled, asked, models, 2, 1)
    assert [(h.label, f) for h, f in found] == [
        ("b", ("b", [0.4, 0.2], {"part": 1.0})),
        ("c", ("c", [0.4, 1.9], {"part": 1.0})),
    ]
    told = {"a": (1.0, 0.1), "b": (1.1, 0.2), "c": (-2.0, 9.0)}
    promised = [h.label for h, _ in promising_fits(NO_DATA, settled, asked, models, 0, 1)]
    assert promised == ["b"]  # a promises no more than what is next to nothing
    assert [h.label for h, _ in promising_fits(NO_DATA, settled, asked, models, 2, 1)] == ["b", "a"]
    told = dict.fromkeys("abcde", (5.0, 0.1))
    names |= {k: (f"{k}.s1",) for k in "de"}
    models |= {k: with_model(k, Parabola(("part", *names[k]), names[k]), [0.0, 0.0]).model for k in "de"}
    everything = [hypothesis(k) for k in "abcde"]
    assert len(promising_fits(NO_DATA, settled, everything, models, 0, 1)) == 3
    assert len(promising_fits(NO_DATA, settled, everything, models, 4, 1)) == 4


@pytest.mark.parametrize(
    ("evidence", "bent", "added"),
    [(4.1, False, True), (3.9, False, False), (-10.9, True, True), (-11.1, True, False)],
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

    def final_ranking(
        o: object, now: Fit, order: Any, found: Any, processes: object, known: Any, past_barriers: bool
    ) -> Any:
        return now, [h.label for h, _ in order], found, known, past_barriers

    straight = fit("bounded", -12.0) if bent else base
    monkeypatch.setattr(finals, "within_scatter", lambda o, one: straight)
    monkeypatch.setattr(finals, "promising_fits", promising)
    monkeypatch.setattr(finals, "finals_of", final_ranking)
    b, c = hypothesis("b"), first.ranked[1].hypothesis
    found: Any = with_promising(NO_DATA, wide, first, [first.ranked[0].hypothesis, b, c], {}, 1)
    if not added:
        assert found is first
        return
    assert asked == [(straight, ["b", "c"], 0)]
    assert found == (wide, ["a", "c"], [(b, more)], (base,), False)


# --- all of it -----------------------------------------------------------------------------------------------------


def test_the_scatter_of_shapes_is_narrowed_half_the_way_where_something_may_have_been_learned_as_scatter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shape = Scatter(SHAPE, "shapes", 0.015, 0.5, 0.03, 1.5, 0.03)
    other = Scatter("part", "parts", 0.02)
    data: Any = SimpleNamespace(scatters={s.name: s for s in (shape, other)})
    monkeypatch.setattr(finals, "refined", lambda o, model, x, scatters: scatters)
    wide: Any = SimpleNamespace(model="base", posterior=SimpleNamespace(x=0))
    wide.posterior.scatters = {SHAPE: 0.0045, "part": 0.03}
    assert narrowed(data, wide) == pytest.approx({SHAPE: 0.0045 / np.sqrt(10), "part": 0.03})
    wide.posterior.scatters = {SHAPE: 0.0008, "part": 0.03}
    assert narrowed(data, wide) is None
    assert narrowed(SimpleNamespace(scatters={}), wide) is None  # type: ignore[arg-type]
