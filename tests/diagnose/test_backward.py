"""What becomes of earlier claims once a later one is known: on claims written down by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from written_fits import fit, hypothesis, law

from ema_pipeline.diagnose import backward
from ema_pipeline.diagnose.backward import cannot_be_told, reconsidered


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
