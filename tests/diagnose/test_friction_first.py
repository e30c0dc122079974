"""Friction that is looked for in full where modes move with the force and nothing found moves them."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest

from ema_pipeline.diagnose.settings import DiagnoseSettings

diagnosis: Any = import_module("ema_pipeline.diagnose.diagnosis")
SETTINGS = DiagnoseSettings(most_effects=3)


def moved_by(*linear: bool, level_dependent: bool = True) -> Any:
    """A selection whose model has effects that are linear or not."""

    def one(label: str, final: bool) -> Any:
        placed = SimpleNamespace(label=label)
        return SimpleNamespace(
            hypothesis=SimpleNamespace(label=label, placed=placed, scales={label: 1.0}), final=final
        )

    first = [one("damper@a", True), one("friction@b", False), one("friction@a", False), one("mass@a", False)]
    second = [one("damper@a", True), one("spring@b", True)]
    rankings = [SimpleNamespace(ranked=first, base="base"), SimpleNamespace(ranked=second, base="more")]
    return SimpleNamespace(
        observations=SimpleNamespace(level_dependent=level_dependent),
        final=SimpleNamespace(
            model=SimpleNamespace(effects=[SimpleNamespace(effect=SimpleNamespace(linear=n)) for n in linear])
        ),
        rounds=[SimpleNamespace(ranking=ranking) for ranking in rankings],
    )


@pytest.mark.parametrize(
    "first", [moved_by(True, False), moved_by(True, level_dependent=False), moved_by(level_dependent=False)]
)
def test_what_is_moved_already_or_does_not_move_is_left(first: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "friction_in_full", lambda *asked: pytest.fail("nothing to look for"))
    assert diagnosis._with_friction_in_full(first, None, [], SETTINGS, print) is first


def test_where_none_gains_the_selection_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    first = moved_by(True)
    monkeypatch.setattr(diagnosis, "friction_in_full", lambda *asked: None)
    monkeypatch.setattr(diagnosis, "select", lambda *asked: pytest.fail("nothing to ask about"))
    assert diagnosis._with_friction_in_full(first, None, [], SETTINGS, lambda *told: None) is first


@pytest.mark.parametrize("moves", [True, False])
def test_friction_is_asked_about_first_and_then_only_what_promised_most(
    moves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, again = moved_by(True), moved_by(not moves)
    asked: list[Any] = []

    def in_full(data: Any, base: Any, effects: Any, processes: Any) -> tuple[str, str, str]:
        assert base == "base"
        assert [placed.label for placed, _ in effects][:4] == [
            "damper@a",
            "friction@b",
            "friction@a",
            "mass@a",
        ]
        return "full data", "friction@a", "fit"

    def select(*given: Any) -> Any:
        asked.extend(given)
        return again

    monkeypatch.setattr(diagnosis, "friction_in_full", in_full)
    monkeypatch.setattr(diagnosis, "select", select)
    found = diagnosis._with_friction_in_full(first, "known", ["all"], SETTINGS, lambda *told: None)
    assert found is (again if moves else first)
    data, known, hypotheses, settings, _, earlier = asked
    assert (data, known, hypotheses, settings) == ("full data", "known", ["all"], SETTINGS)
    assert [h.label for h in earlier.leading] == ["friction@a", "damper@a", "spring@b"]
    assert earlier.closed
    assert earlier.rounds > SETTINGS.most_effects
    assert earlier.fitted == {"friction@a": "fit"}
