"""Which hypotheses are fitted, from where, and how they are ranked: on fits written down by hand."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from written_fits import NO_DATA, Parabola, fit, found_of, hypothesis, law, score, with_model

from ema_pipeline.diagnose import ranking
from ema_pipeline.diagnose.first_fits import Tried
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.diagnose.ranking import (
    _batches,
    _begun_again,
    _best_tried,
    _better,
    _bettered,
    _contenders,
    _decides,
    _screened,
)
from ema_pipeline.observations.fitting import Fit


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
    directed = [hypothesis(k, sizes=2, directed=True) for k in ("promising", "not promising")]
    promise |= {"promising": score(2.5), "not promising": score(-100.0)}
    assert _screened([*own, *directed], promise, near=True) == [*own[3:], directed[0]]
    assert _screened([*own, *directed], promise, near=False) == [*own, *directed]
    promise |= {h.label: score(1.0) for h in generic[4:]}
    assert len(_screened(everything, promise, near=True)) == 16 + 12


# --- the order of fits ---------------------------------------------------------------------------------------------


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
    assert _best_tried(tried, 8) == {f"h{k}" for k in range(12, 20)}
    # costs tell little where nominal modes coincide: partners at plain uncertainties count as well
    tried |= {"h2": Tried(8.0, 2.0, 18.0), "h3": Tried(8.0, 3.0, 39.0), "h1": Tried(8.0, 1.0, 39.0)}
    assert _best_tried(tried, 2) == {"h18", "h19", "h3", "h1"}


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
        ranking, "known_from", lambda o, model, source, sizes: f"{sizes.model.name} at {source.model.name}"
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


def test_a_better_fit_is_kept_and_the_same_start_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = with_model("a", Parabola(("part", "a.s"), ("a.s",)), [0.1, 0.3], 5.0)
    sources = [with_model("b", Parabola(("part",), ()), [v]) for v in (0.14, 0.5, 0.7)]
    tried = []

    def refined(observations: object, model: Any, x: np.ndarray, steps: int) -> Fit:
        tried.append((x.tolist(), steps))
        return with_model("a", Parabola(("part", "a.s"), ("a.s",)), x.tolist(), 10.0 * (1.2 - x[0]))

    monkeypatch.setattr(ranking, "refined", refined)
    best = _better(NO_DATA, sources, 4, mine)
    assert tried == [([0.5, 0.3], 4), ([0.7, 0.3], 4)]
    assert best.x.tolist() == [0.5, 0.3]


LEARNED = 5.0
"""Log evidence of a fit whose scatters are learned."""


def named(one: Fit) -> str:
    return "learned" if one.log_evidence == LEARNED else one.model.name  # type: ignore[attr-defined]


class Stages:
    """Stands for every stage of `rank`, and keeps what it was asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, bent: bool = False) -> None:
        self.asked: list[Any] = []
        self.short, self.bent = False, bent
        labels = ("a", "b", "c", "d", "e", "f", "unseen")
        self.hypotheses = [hypothesis(k) for k in labels]
        stds = dict.fromkeys(labels, 9e5) | {"unseen": 1e6}
        told = [
            SimpleNamespace(hypothesis=h, std=stds[h.label], gain=0.0)
            for h in self.hypotheses
            if h.label != "f"
        ]
        monkeypatch.setattr(ranking, "scores", lambda *given: told)
        monkeypatch.setattr(ranking, "learned", lambda o, one, past_barriers=True: fit("base", LEARNED))
        monkeypatch.setattr(ranking, "narrowed", lambda o, settled: None)
        monkeypatch.setattr(ranking, "unbent", lambda o, one: not bent)
        monkeypatch.setattr(ranking, "within_scatter", lambda o, one: fit("bounded", 0.0) if bent else one)
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
        monkeypatch.setattr(ranking, "promising_fits", self.promising)
        monkeypatch.setattr(
            ranking, "with_promising", lambda o, base, found, hypotheses, models, processes: found
        )
        monkeypatch.setattr(
            ranking,
            "finals_of",
            lambda o, base, order, promising, processes, known, past_barriers: (
                base,
                order,
                list(promising),
                [named(f) for f in known] + ["past barriers"] * past_barriers,
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

    def first_fit(
        self, how: str, o: object, base: object, models: Any, promise: Any, h: Any, near: bool = False
    ) -> Any:
        assert near is (how == "first" and not self.bent)
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
        self.asked.append(("promising", named(settled), [h.label for h in others], further))
        return ["more"]

    def rank(self, base: Fit, **given: Any) -> Any:
        told: list[tuple[float, str]] = []
        found = ranking.rank(
            NO_DATA, base, self.hypotheses, progress=lambda share, text: told.append((share, text)), **given
        )
        assert [share for share, _ in told] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8])
        return found


@pytest.mark.parametrize(
    ("unpaired", "unexplained", "annealed"), [(2.0, 0, "ef"), (1.9, 0, "bef"), (2.0, 1, "bef")]
)
def test_those_behind_in_short_fits_are_annealed_where_a_size_leads_modes_to_partners(
    monkeypatch: pytest.MonkeyPatch, unpaired: float, unexplained: int, annealed: str
) -> None:
    """A few steps do not. Doubtful modes that had no partner in an earlier round are not looked for again."""
    stages = Stages(monkeypatch)
    stages.base.posterior.residuals.unexplained = unexplained  # type: ignore[misc]
    stages.base.posterior.error = 1.31  # type: ignore[misc]
    best_first = [(h, SimpleNamespace(log_evidence=0.0, error=1.0)) for h in stages.hypotheses[-2::-1]]
    monkeypatch.setattr(ranking, "short_fits", lambda *given: best_first)
    monkeypatch.setattr(ranking, "_ANNEALED", 2)
    ranking.rank(NO_DATA, stages.base, stages.hypotheses, unpaired=unpaired)
    assert [asked[1] for asked in stages.asked if asked[0].startswith("annealed")] == list(annealed)


@pytest.mark.parametrize(("evidence", "others"), [(0.9, ["f"]), (1.1, ["e", "f"])])
def test_near_the_base_model_scores_tell_where_fits_begin(
    monkeypatch: pytest.MonkeyPatch, evidence: float, others: list[str]
) -> None:
    """The fifth at wide scatters, which gains nothing there, may promise something beside learned ones all the same."""
    stages = Stages(monkeypatch)
    stages.base.posterior.log_evidence = evidence  # type: ignore[misc]
    stages.base.posterior.residuals.unexplained = 0  # type: ignore[misc]
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
    assert stages.asked[7:] == [("freed", 6), ("again", 6, 12), ("promising", "learned", others, 2)]


@pytest.mark.parametrize("bent", [False, True])
def test_what_promises_beside_narrow_shapes_is_a_finalist_whatever_was_one_before(
    monkeypatch: pytest.MonkeyPatch, bent: bool
) -> None:
    """What is missing may have been learned as scatter."""
    stages = Stages(monkeypatch, bent)
    monkeypatch.setattr(ranking, "narrowed", lambda o, settled: fit("narrow", 0.0))
    stages.base.posterior.residuals.unexplained = 0  # type: ignore[misc]
    _, _, promising, known = stages.rank(stages.base, further=2, unpaired=2.0)
    assert promising == ["more", "more"]
    assert stages.asked[-1] == ("promising", "narrow", ["a", "b", "c", "d", "e", "f"], 0)
    assert known == (["learned", "past barriers"] if bent else ["learned", "learned"])


@pytest.mark.parametrize(
    ("error", "unexplained", "unpaired", "bent", "searched"),
    [
        (1.31, 0, 2.0, False, False),
        (1.31, 0, 1.9, False, True),
        (1.3, 1, 1.9, False, True),
        (1.31, 1, 2.0, False, True),  # another effect may be what it lacks
        (1.3, 0, 2.0, True, False),
        (1.3, 0, 1.9, True, False),  # all that was surely measured is explained
    ],
)
def test_a_base_model_that_is_stuck_or_bent_is_begun_again_with_all(
    monkeypatch: pytest.MonkeyPatch,
    error: float,
    unexplained: int,
    unpaired: float,
    bent: bool,
    searched: bool,
) -> None:
    stages = Stages(monkeypatch, bent)
    stages.base.posterior.error = error  # type: ignore[misc]
    stages.base.posterior.residuals.unexplained = unexplained  # type: ignore[misc]
    _, _, promising, known = stages.rank(stages.base, further=2, unpaired=unpaired)
    assert known == ["past barriers"]
    assert stages.asked[0][2] is False
    assert stages.asked[1] == ("first" if bent else f"annealed{int(searched)}", "a", 6)
    assert stages.short
    assert stages.asked[7:10] == [("again", 6, 5), ("freed", 6), ("again", 6, 12)]
    # on top of one that is bent little promises anything, so that no part of it stands out first
    assert promising == ["more"] * bent
    assert stages.asked[10:] == [("promising", "bounded", ["f"], 0)] * bent


@pytest.mark.parametrize(
    ("error", "bent", "evidence", "known"),
    [
        (1.0, False, LEARNED + 1, ["reached"]),  # scores and first fits begin there as well
        (1.0, False, LEARNED - 1, ["learned"]),
        (1.0, True, LEARNED + 1, ["reached", "past barriers"]),
        (1.31, False, LEARNED - 1, ["reached", "past barriers"]),
    ],
)
def test_a_base_model_is_no_worse_than_the_fit_with_which_its_last_effect_was_added(
    monkeypatch: pytest.MonkeyPatch, error: float, bent: bool, evidence: float, known: list[str]
) -> None:
    stages = Stages(monkeypatch, bent)
    stages.base.posterior.error = error  # type: ignore[misc]
    stages.base.posterior.residuals.unexplained = 0  # type: ignore[misc]
    reached = fit("reached", evidence)
    stages.base.model.name = "reached"  # type: ignore[attr-defined]
    assert stages.rank(stages.base, unpaired=2.0, reached=[reached])[3] == known
