"""What becomes of earlier claims once a later one is known: on claims written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from written_fits import fit, hypothesis, law

from ema_pipeline.diagnose import backward
from ema_pipeline.diagnose.backward import alike_beside, cannot_be_told, reconsidered


def at(one: Any, place: str, unit: str = "1") -> Any:
    one.placed.place = place
    for p in one.placed.effect.parameters:
        p.unit = unit
    return one


LOSS, TEETH, ELSEWHERE, MASS = (
    at(hypothesis("loss@mesh1"), "mesh1"),
    at(law("teeth@mesh1"), "mesh1"),
    at(hypothesis("loss@mesh2"), "mesh2"),
    at(hypothesis("mass@mesh1"), "mesh1", "kg"),
)


def test_what_linearisation_leaves_of_a_law_is_a_linear_effect_at_its_place() -> None:
    hits: Any = SimpleNamespace(linearised=True)
    assert cannot_be_told(hits, LOSS, TEETH)
    assert not cannot_be_told(hits, TEETH, LOSS)
    assert not cannot_be_told(hits, ELSEWHERE, TEETH)
    assert not cannot_be_told(SimpleNamespace(linearised=False), LOSS, TEETH)  # type: ignore[arg-type]


@pytest.mark.parametrize("linearised", [True, False])
def test_a_linear_claim_goes_once_a_law_at_its_place_is_claimed(
    monkeypatch: pytest.MonkeyPatch, linearised: bool
) -> None:
    claimed: Any = [
        SimpleNamespace(hypothesis=h, ranked=SimpleNamespace(fit=fit(h.label, 1.0)))
        for h in (LOSS, ELSEWHERE, MASS, TEETH)
    ]
    fitted: list[list[str]] = []

    def fitted_anew(observations: object, known: object, effects: Any, near: Any) -> Any:
        fitted.append([h.label for h in effects])
        assert near.model.name == TEETH.label  # from where the fit with all of them ended
        return fit("without", 2.0)

    monkeypatch.setattr(backward, "_fitted", fitted_anew)
    monkeypatch.setattr(backward, "learned", lambda observations, one: one)
    monkeypatch.setattr(backward, "_best_change", lambda *given: None)
    monkeypatch.setattr(
        backward, "_judged_anew", lambda o, start, effects, found, s: [*effects, found.model.name]
    )
    found: Any = reconsidered(
        SimpleNamespace(linearised=linearised),
        fit("start", 0.0),
        claimed,
        {},
        SimpleNamespace(),  # type: ignore[arg-type]
    )
    if linearised:
        assert fitted == [[ELSEWHERE.label, MASS.label, TEETH.label]]
        assert found == [ELSEWHERE, MASS, TEETH, "without"]
    else:
        assert fitted == []
        assert found == claimed


def test_rivals_of_an_early_claim_are_judged_anew_with_the_later_ones_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of one claim nothing is fitted again; what is claimed itself is no rival; what was far behind may be one."""
    mass, spring, other, far, behind = (
        SimpleNamespace(hypothesis=hypothesis(name), ranked=name)
        for name in ("mass@q3", "spring@q1", "mass@q3.x", "mass@all", "mass@q2")
    )
    near = {"mass@q3": (mass, other, spring), "spring@q1": (spring, mass)}
    judged = {"mass@q3": (mass, other, spring, far, behind), "spring@q1": (spring, mass)}
    rounds: Any = {
        name: SimpleNamespace(alike=lambda s, name=name: near[name], judged=judged[name]) for name in near
    }
    evidence = {"mass@q3.x": 99.0, "mass@all": 40.0, "mass@q2": 98.5, "": 30.0}
    asked: list[list[str]] = []

    def fitted(observations: object, known: object, effects: Any, final: object, rival: Any = None) -> Any:
        asked.append([h.label for h in effects])
        posterior = SimpleNamespace(log_evidence=evidence["" if rival is None else rival.hypothesis.label])
        return SimpleNamespace(posterior=posterior, log_evidence=posterior.log_evidence)

    def anew(observations: object, ranking: Any, ranked: Any, settings: object) -> Any:
        assert ranking.base.log_evidence == 30.0  # the other claims without any of these
        label, gain = ranked
        return SimpleNamespace(hypothesis=hypothesis(label), gain=gain)

    monkeypatch.setattr(backward, "_fitted", fitted)
    monkeypatch.setattr(backward, "_with", lambda known, effects: None)
    monkeypatch.setattr(backward, "replace", lambda label, fit, gain: (label, gain))
    monkeypatch.setattr(backward, "judge", anew)
    settings: Any = SimpleNamespace(processes=1, alike=3.0)
    nothing: Any = None
    final: Any = SimpleNamespace(log_evidence=100.0)

    def told(*claimed: Any) -> list[list[str]]:
        groups = alike_beside(nothing, nothing, claimed, rounds, final, settings)
        assert [j.gain for group in groups for j in group[1:] if hasattr(j, "gain")] in ([], [69.0, 68.5])
        return [[j.hypothesis.label for j in group] for group in groups]

    assert told(mass, spring) == [["mass@q3", "mass@q3.x", "mass@q2"], ["spring@q1"]]
    assert asked == [["spring@q1"], *([name, "spring@q1"] for name in ("mass@q3.x", "mass@all", "mass@q2"))]
    asked.clear()
    assert told(mass) == [["mass@q3", "mass@q3.x", "spring@q1"]]
    assert not asked
    again: Any = SimpleNamespace(hypothesis=mass.hypothesis)  # judged anew, after the spring
    assert told(spring, again) == [["spring@q1"], ["mass@q3", "mass@q3.x", "mass@q2"]]
    assert asked == [["spring@q1"], *(["spring@q1", name] for name in ("mass@q3.x", "mass@all", "mass@q2"))]
