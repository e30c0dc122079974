"""The largest size of an effect that shows the more the smaller it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ema_pipeline.diagnose.detection_limits import _Shown, _under
from ema_pipeline.diagnose.hypotheses import Hypothesis, Name
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.library import effect_library
from ema_pipeline.observations.rig_model import LOG_STD

GAIN = 20.0


def shown(monkeypatch: pytest.MonkeyPatch, edge: float, asked: list[float]) -> _Shown:
    """An effect whose gain is enough at unknowns up to `edge`."""

    def gained(self: Any, unknown: float) -> tuple[float, float]:
        asked.append(unknown)
        return (30.0 if unknown <= edge else 5.0), 8.0

    monkeypatch.setattr(_Shown, "_gained", gained)
    nothing: Any = None
    return _Shown(nothing, np.zeros(1), 0, {}, nothing, nothing, 1.0, linear=False)


@pytest.mark.parametrize("edge", [2.9, 0.3, -3.0])
def test_the_largest_size_is_found_to_within_a_twelfth_of_itself(
    monkeypatch: pytest.MonkeyPatch, edge: float
) -> None:
    asked: list[float] = []
    found = shown(monkeypatch, edge, asked).largest(GAIN)
    assert edge - np.log(2) / LOG_STD / 8 < found <= edge
    assert len(asked) <= 14 + 3


def test_what_no_size_shows_and_what_costs_more_than_it_gains_has_no_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert shown(monkeypatch, -100.0, []).largest(GAIN) == -np.inf
    assert shown(monkeypatch, 0.3, []).largest(28.0) == -np.inf  # 28 and ½ ln(1 + 8²) for knowing the size


def test_the_limit_is_a_size_of_the_parameter_and_nothing_where_none_shows() -> None:
    teeth = effect_library()["mesh_backlash"]
    name = Name(PlacedEffect(teeth, "sun-planet1"), {"preload": 1e-5, "gap": 1e-4}, 1.0)
    hypothesis = Hypothesis((name,))
    assert hypothesis.shown_by_less
    assert not Hypothesis((Name(PlacedEffect(effect_library()["spring"], "sun.x"), {}, 1.0),)).shown_by_less
    limit = _under(name, hypothesis, 0.5)
    assert limit.largest
    assert limit.size == pytest.approx(2e-6 * np.exp(0.5 * LOG_STD))
    none = _under(name, hypothesis, -np.inf)
    assert (none.size, none.seen) == (0.0, False)
