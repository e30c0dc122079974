"""Where the fits of hypotheses begin: on fits written down by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from written_fits import NO_DATA, PENALTY, Parabola, fit, hypothesis, score, with_model

from ema_pipeline.diagnose import first_fits
from ema_pipeline.diagnose.first_fits import (
    Tried,
    _best_of_grid,
    _from_nominal,
    _starts,
    annealed_fit,
    continued_fit,
    first_fit,
    short_fits,
    tried_sizes,
)
from ema_pipeline.inference import Unknowns


def test_short_fits_begin_at_the_scores_of_what_has_one_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    everything = [hypothesis(f"h{k}") for k in range(20)]
    others = [hypothesis("two sizes", sizes=2), hypothesis("not scored"), hypothesis("by level")]
    others[2].placed.effect.linear = False
    promise = {h.label: score(0.0) for h in [*everything, *others]} | {
        "two sizes": SimpleNamespace(size=np.zeros(2))
    }
    del promise["not scored"]
    asked: list[tuple[str, Any, int]] = []

    def refined(observations: object, model: str, x: Any, steps: int) -> Any:
        asked.append((model, x, steps))
        return SimpleNamespace(name=model, log_evidence=float(7 * int(model[1:]) % 20))

    def from_score(o: object, base: object, model: str, h: Any, told: Any, steps: int) -> Any:
        return refined(o, model, (h.label, told), steps)

    monkeypatch.setattr(first_fits, "_from_score", from_score)
    models = {h.label: h.label for h in [*everything, *others]}
    kept = short_fits(NO_DATA, fit("base", 0.0), models, promise, [*others, *everything], 1)  # type: ignore[arg-type]
    assert asked == [(h.label, (h.label, promise[h.label]), 8) for h in everything]
    assert [p.log_evidence for _, p in kept] == list(range(19, -1, -1))  # type: ignore[attr-defined]
    assert all(p.name == h.label for h, p in kept)  # type: ignore[attr-defined]


def test_fits_begin_at_usual_sizes_and_once_with_parts_that_are_not_bent() -> None:
    problem: Any = Parabola(("part", "common", "a.s1"), ("a.s1",))
    begin = np.array([0.4, 0.5, 0.0])
    starts = _starts(NO_DATA, problem, hypothesis("a"), begin)
    np.testing.assert_array_equal(starts, [[0.4, 0.5, 0.5], [0.4, 0.5, -0.5], [0.0, 0.5, 0.5]])
    told = _starts(NO_DATA, problem, hypothesis("a"), begin, score(3.0, 0.07))
    np.testing.assert_array_equal(told, [*starts, [0.4, 0.5, 0.07]])
    near = _starts(NO_DATA, problem, hypothesis("a"), begin, near=True)  # the base model has bent nothing
    np.testing.assert_array_equal(near, starts[:2])


def test_where_a_free_parameter_is_far_off_one_fit_begins_at_nominal_values() -> None:
    """Earlier effects keep their sizes; what has a scatter or a narrow prior is no free parameter."""
    problem: Any = Parabola(("part", "free", "known", "earlier.s1", "a.s1"), ("earlier.s1", "a.s1"))
    problem.unknowns.std[:] = [1.0, 1.2, 0.05, 1.0, 1.0]
    one = hypothesis("a")
    found = _from_nominal(problem, one, np.array([0.4, 0.61, 0.5, 0.7, 0.0]))
    np.testing.assert_array_equal(found, [[0.0, 0.0, 0.0, 0.7, 0.5]])
    assert _from_nominal(problem, one, np.array([1.4, 0.59, 0.5, 0.7, 0.0])) == []


@pytest.mark.parametrize(("lost", "starts"), [(0, 3), (1, 4)])
def test_nominal_values_are_tried_where_the_base_model_has_lost_a_mode(
    monkeypatch: pytest.MonkeyPatch, lost: int, starts: int
) -> None:
    base = with_model("base", Parabola(("free",), ()), [1.5])
    base.posterior.residuals = SimpleNamespace(unexplained=lost)  # type: ignore[misc]
    model = with_model("a", Parabola(("free", "a.s1"), ("a.s1",)), [0.0, 0.0]).model
    asked: list[Any] = []

    def annealed(observations: object, of: object, begun: list[np.ndarray], schedule: object) -> Any:
        asked.extend(begun)
        return with_model("a", Parabola((), ()), [])

    monkeypatch.setattr(first_fits, "annealed", annealed)
    annealed_fit(NO_DATA, base, {"a": model}, {}, {}, hypothesis("a"))
    assert len(asked) == starts
    assert (asked[-1].tolist() == [0.0, 0.5]) is bool(lost)


def test_where_sizes_are_given_one_fit_begins_where_that_of_the_base_model_did() -> None:
    """With the sizes of effects that the model has already as the base model's fit has them."""
    names = ("spring", "known.s1", "a.s1")
    problem: Any = Parabola(names, names[1:], np.array([0.1, 0.2, 0.3]))
    starts = _starts(NO_DATA, problem, _given(), np.array([0.4, 0.7, 0.0]))
    np.testing.assert_array_equal(starts, [[0.4, 0.7, 0.5], [0.4, 0.7, -0.5], [0.1, 0.7, 0.5]])
    near = _starts(NO_DATA, problem, _given(), np.array([0.4, 0.7, 0.0]), near=True)
    np.testing.assert_array_equal(
        near, starts
    )  # in forces in time everything may be bent, whatever the error


def _given() -> Any:
    one = hypothesis("a")
    one.begun = tuple(one.starts())
    return one


def test_an_effect_that_adds_modes_begins_at_the_best_of_a_grid() -> None:
    names = ("part", "a.s1", "a.s2")
    problem: Any = Parabola(names, names[1:], np.array([0.0, 0.55, -1.1]))
    data: Any = SimpleNamespace(scatters={})
    one = hypothesis("a", sizes=2, extends=True)
    best = _best_of_grid(data, problem, np.array([0.4, 0.0, 0.0]), one)
    nearest = [(0.5, -1.0), (0.5, -1.5), (1.0, -1.0), (0.0, -1.0), (1.0, -1.5)]
    assert best == [{"a.s1": a, "a.s2": b} for a, b in nearest]
    starts = _starts(data, problem, one, np.array([0.4, 0.0, 0.0]))
    np.testing.assert_array_equal(starts, [[k, *near] for k in (0.4, 0.0) for near in nearest])
    beside = _starts(data, problem, one, np.array([0.4, 0.0, 0.0]), near=True)
    np.testing.assert_array_equal(beside, starts[:5])


@pytest.mark.parametrize(
    ("promised", "costs", "begun"),
    [
        (0.8, (5.0,), 0.4),
        (0.8, (5.01,), 0.4),  # no size, in fewer steps than the base model had
        (4.0, (5.0,), 1.0),
        (0.8, (5.1, 4.9), 0.05),
        (-0.8, (5.1, 4.9), -0.05),
        (0.8, (5.1, 5.1), None),
    ],
)
def test_the_first_fit_begins_at_half_the_size_that_its_score_tells(
    monkeypatch: pytest.MonkeyPatch, promised: float, costs: tuple[float, ...], begun: float | None
) -> None:
    """At little of it where that makes matters worse; where that does, too, or nothing is promised, it is annealed."""
    base = with_model("base", Parabola(("part",), ()), [0.4])
    problem = Parabola(("part", "a.s1"), ("a.s1",))
    model = with_model("a", problem, [0.0, 0.0]).model
    annealed: list[Any] = []
    left = list(costs)

    def refined(observations: object, model: Any, x: np.ndarray, steps: int) -> Any:
        cost = left.pop(0)
        return SimpleNamespace(posterior=SimpleNamespace(cost=cost, log_evidence=-cost, x=x))

    best = SimpleNamespace(log_evidence=-5.05, name="annealed")

    def anneal(observations: object, model: Any, starts: Any, schedule: Any) -> Any:
        annealed.append((len(starts), schedule))
        return SimpleNamespace(posterior=best)

    monkeypatch.setattr(first_fits, "refined", refined)
    monkeypatch.setattr(first_fits, "annealed", anneal)
    found: Any = first_fit(NO_DATA, base, {"a": model}, {"a": score(3.0, promised)}, hypothesis("a"))
    assert not left
    if begun is None:
        assert found is best  # worse than the base model, yet better than where the fit of the score ended
        assert annealed == [(4, first_fits.QUICK)]  # usual sizes, and the one that the score tells
    else:
        assert found.x.tolist() == [0.4, begun]
        assert annealed == []
    without: Any = first_fit(NO_DATA, base, {"a": model}, {}, hypothesis("a"))
    assert without is best


def test_sizes_far_out_and_small_ones_are_tried_where_modes_have_no_partner() -> None:
    """Of effects of one linear size, with parts that are not bent; the best that gives a mode a partner is kept."""
    base = with_model("base", Parabola(("part",), ()), [0.4])

    def asked(label: str, at: float, partner_from: float = np.inf, **kind: Any) -> Any:
        names = ("part", f"{label}.s1")
        problem = Parabola(names, names[1:], np.array([0.0, at]), partner_from)
        problem.unknowns = Unknowns(names, np.ones(2), ("part", ""), np.full(2, -20.0), np.full(2, 9.0))
        models[label] = with_model(label, problem, [0.0, 0.0]).model
        return hypothesis(label, **kind)

    models: dict[str, Any] = {}
    law = asked("law", 8.0, 3.0)
    law.placed.effect.linear = False
    everything = [
        asked("far", 7.0, 3.0),
        asked("below", -14.0, -5.0),
        asked("beyond its range", 20.0, 3.0),
        asked("makes matters worse", 0.0, 15.0),
        asked("gives none a partner", 8.0),
        asked("small", 0.025, 0.02),
        asked("two", 8.0, 3.0, sizes=2),
        asked("extends", 8.0, 3.0, extends=True),
        law,
    ]
    data: Any = SimpleNamespace(scatters={})
    found = tried_sizes(data, base, models, everything, 1)
    assert {label: one.unknown for label, one in found.items()} == {
        "far": 8.0,
        "small": 0.03,
        "below": -15.0,
        "beyond its range": 8.0,
    }
    assert found["far"].gain == pytest.approx(PENALTY + 0.5 * (7.0**2 - 1.0) / 30.0**2)


NAMES = ("part", "a.s1")


def tried_of(problem: Parabola) -> Tried:
    """The best of some sizes of the one effect of a problem of `NAMES`."""
    problem.unknowns = Unknowns(NAMES, np.ones(2), ("part", ""), np.full(2, -20.0), np.full(2, 9.0))
    base = with_model("base", Parabola(("part",), ()), [0.4])
    model = with_model("a", problem, [0.0, 0.0]).model
    data: Any = SimpleNamespace(scatters={})
    return tried_sizes(data, base, {"a": model}, [hypothesis("a")], 1)["a"]


def costing(
    monkeypatch: pytest.MonkeyPatch, problem: Parabola, further: Callable[[float], float]
) -> Parabola:
    """A problem with a further cost, by the size."""
    plain = problem.residuals

    def residuals(x: np.ndarray, scatters: Any, **more: Any) -> Any:
        found = plain(x, scatters, **more)
        return replace(found, log_scale=found.log_scale + further(float(x[1])))

    monkeypatch.setattr(problem, "residuals", residuals)
    return problem


def test_what_turns_coinciding_modes_at_any_size_is_told_by_the_larger_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As a gyroscopic effect turns the double modes of nominal parts: the smallest size costs as much as a true one."""
    problem = Parabola(NAMES, NAMES[1:], np.array([0.0, 7.0]), 3.0)
    found = tried_of(costing(monkeypatch, problem, lambda size: 100.0 if size else 0.0))
    assert found.unknown == 8.0
    assert found.gain == pytest.approx(PENALTY + 0.5 * ((7.0 - 0.003) ** 2 - 1.0) / 30.0**2)


def test_what_gives_a_mode_a_partner_is_tried_though_it_turns_other_modes_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A spring at a planet lifts the rotation of a gear train from 0 Hz, and splits double modes of nominal parts."""
    problem = Parabola(NAMES, NAMES[1:], np.array([0.0, 7.0]), 3.0)
    assert tried_of(costing(monkeypatch, problem, lambda size: 100.0 * size)) == Tried(4.0, PENALTY)


def test_sizes_that_give_modes_a_partner_are_tried_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Parabola(NAMES, NAMES[1:], np.array([0.0, 5.8]), 5.0)
    asked: list[Any] = []

    def tuned(x: np.ndarray, name: str) -> list[float]:
        asked.append((x.tolist(), name))
        return [-20.0, 5.7, 4.0, 6.0, 9.5]  # of which the first and the last are beyond its range

    def unpaired(x: np.ndarray, scatters: object, heat: float) -> float:
        """Two modes, one of which has a partner from 5; more uncertainty gives both one."""
        assert heat in (1.0, 30.0)
        return (PENALTY if x[1] < 5.0 else 0.0) + (9.0 if heat == 1.0 else 0.0)

    monkeypatch.setattr(problem, "tuned", tuned)
    monkeypatch.setattr(problem, "unpaired", unpaired)
    found = tried_of(problem)
    assert found.unknown == 5.7
    assert (found.pairs, found.tuned) == (PENALTY, (5.7, 6.0))
    assert asked == [([0.0, 0.0], "a.s1")]


def test_sizes_that_give_modes_a_partner_are_annealed_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """While hot, sizes that do nothing cost less, and would win the race."""
    base = with_model("base", Parabola(("part",), ()), [0.4])
    model = with_model("a", Parabola(("part", "a.s1"), ("a.s1",)), [0.0, 0.0]).model
    raced: list[Any] = []

    def annealed(observations: object, model: Any, starts: Any, schedule: object) -> Any:
        raced.append([x.tolist() for x in starts])
        return fit("a", float(len(raced)))

    monkeypatch.setattr(first_fits, "annealed", annealed)
    known = {"a": Tried(0.003, 9.0, PENALTY, (1.2, 1.5))}
    found = annealed_fit(NO_DATA, base, {"a": model}, {}, known, hypothesis("a"))
    assert raced[1:] == [[[0.0, 1.2], [0.0, 1.5]]]
    assert found.log_evidence == 2.0
    raced.clear()
    annealed_fit(NO_DATA, base, {"a": model}, {}, {"a": Tried(0.003, 9.0)}, hypothesis("a"))
    assert len(raced) == 1


def test_one_fit_begins_at_the_best_of_the_sizes_that_were_tried() -> None:
    problem: Any = Parabola(("part", "a.s1"), ("a.s1",))
    starts = _starts(NO_DATA, problem, hypothesis("a"), np.array([0.4, 0.0]), None, Tried(1.5, 9.0))
    np.testing.assert_array_equal(starts[-1], [0.0, 1.5])
    assert len(starts) == 4


@pytest.mark.parametrize(
    ("continued", "kept"), [(1.0, "continued"), (-1.0, "otherwise"), (-0.2, "continued")]
)
def test_a_fit_goes_on_where_one_with_fewer_unknowns_ended(
    monkeypatch: pytest.MonkeyPatch, continued: float, kept: str
) -> None:
    base = with_model("base", Parabola(("part", "new"), ()), [0.4, 0.7], 0.0)
    model = with_model("a", Parabola(("part", "new", "a.s1"), ("a.s1",)), [0.0] * 3).model
    before = with_model("a", Parabola(("part", "a.s1"), ("a.s1",)), [0.1, 0.9]).posterior
    anew: list[str] = []

    def refined(observations: object, model: Any, x: np.ndarray, steps: int) -> Any:
        np.testing.assert_array_equal(x, [0.1, 0.7, 0.9])  # what is new as the base model has it
        return SimpleNamespace(posterior=SimpleNamespace(log_evidence=continued, name="continued"))

    def otherwise() -> Any:
        anew.append("asked")
        return SimpleNamespace(log_evidence=-0.5, name="otherwise")

    monkeypatch.setattr(first_fits, "refined", refined)
    found: Any = continued_fit(NO_DATA, base, model, before, otherwise)
    assert found.name == kept
    assert bool(anew) is (continued <= 0.0)
