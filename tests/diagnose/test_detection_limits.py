"""Limits of effects that show the more the smaller they are, and of those that bend what is predicted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imperfect_modes import NORMAL, chain, chain_modes
from scipy.optimize import least_squares

from ema_pipeline.diagnose.detection_limits import _Shown, _under
from ema_pipeline.diagnose.expected_gain import ExpectedGain
from ema_pipeline.diagnose.hypotheses import Hypothesis, Name, list_hypotheses
from ema_pipeline.diagnose.score import Marginal, first_order_changes
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.library import effect_library, shipped_effects
from ema_pipeline.inference import Posterior, Residuals, Unknowns
from ema_pipeline.observations.fitting import Model, fit_base, learned
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.observations.size_map import LOG_STD

GAIN = 20.0


def shown(monkeypatch: pytest.MonkeyPatch, edge: float, asked: list[float]) -> _Shown:
    """An effect whose gain is enough at unknowns up to `edge`."""

    def gained(self: Any, unknown: float) -> tuple[float, float]:
        asked.append(unknown)
        return (30.0 if unknown <= edge else 5.0), 8.0

    monkeypatch.setattr(_Shown, "_gained_at", gained)
    nothing: Any = None
    return _Shown(nothing, np.zeros(1), 0, {}, nothing, nothing, nothing, 1.0, linear=False)


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


class Bent:
    """An effect that bends predictions with the square of its size; two unknowns follow it, one of them in a curve."""

    def __init__(self, curve: float) -> None:
        self.curve = curve

    unknowns = Unknowns.plain(("a", "b", "damper@m.coefficient"), 1.0)

    @staticmethod
    def uninterpolated(x: np.ndarray) -> np.ndarray:
        return x

    @staticmethod
    def modes_added(x: np.ndarray, further: np.ndarray) -> int:
        return 0

    def residuals(
        self, x: Any, scatters: Any, *, derivatives: bool = True, matching: Any = None
    ) -> Residuals:
        a, b, size = x
        values = np.array(
            [
                10 * a + 0.6 * size + size**2,
                5 * b + self.curve * b**2 + 3 * size**2,
                4 * a - 2 * b,
                2 * b + size**2,
            ]
        )
        slope = np.array(
            [
                [10, 0, 0.6 + 2 * size],
                [0, 5 + 2 * self.curve * b, 6 * size],
                [4, -2, 0],
                [0, 2, 2 * size],
            ]
        )
        return Residuals(values, slope, matching=matching or (np.arange(2),))


def bent(curve: float) -> _Shown:
    problem = Bent(curve)
    x = np.zeros(3)
    before = problem.residuals(x, {})
    fit = SimpleNamespace(posterior=Posterior(problem.unknowns, x, {}, before))
    marginal = Marginal(fit, without="damper@m")  # type: ignore[arg-type]
    nothing = Residuals(np.zeros(4), np.zeros((4, 3)))
    gains = ExpectedGain(Posterior(problem.unknowns, x, {}, nothing), {}, marginal)
    slope = before.jacobian[:, 2]
    return _Shown(problem, x, 2, {}, before, slope, gains, 1.0, linear=True)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [0.8, 1.5, 2.0])
def test_everything_follows_an_effect_as_it_would_in_a_fit(size: float) -> None:
    one = bent(0.3)
    first, begin, change = one._moved(size)
    assert change is not None
    followed = one._followed(begin, change)
    assert followed is not None

    def asked(free: Any) -> Any:
        there = Bent(0.3).residuals((*free, size), {}).values
        return np.concatenate([there, free])

    best = 2 * least_squares(asked, [0.0, 0.0]).cost
    assert followed.total == pytest.approx(best, rel=0.05)
    assert best > 1.5 * first.total  # to first order nearly nothing is left


@pytest.mark.parametrize(("above", "expected"), [(-0.9, (0.8, -0.9)), (-1.1, (2.0, -3.0)), (0.4, (0.8, 0.4))])
def test_a_limit_is_sought_about_the_largest_size_that_can_be_followed(
    monkeypatch: pytest.MonkeyPatch, above: float, expected: tuple[float, float]
) -> None:
    """Where it nearly shows: else a limit is one size or twenty times that by a rounding of its gain."""
    asked: list[float] = []

    def gained(self: Any, unknown: float, gain: float, sigmas: float) -> tuple[float, bool]:
        asked.append(unknown)
        return (above, True) if unknown < 1.0 else (-2.0, False)

    monkeypatch.setattr(_Shown, "_above", gained)
    assert bent(0.0)._nearer(2.0, -3.0, GAIN, 2.0) == pytest.approx(expected)
    assert asked == pytest.approx([0.8])


@pytest.mark.parametrize("label", ["spring@m2-m3", "mass@m3", "damper@m3", "sensor_mass@m2"])
def test_slopes_of_all_effects_at_once_are_those_of_each(label: str) -> None:
    rig = chain()
    observations = ModeObservations(rig, [prepare(m) for m in chain_modes(3, NORMAL).values()])
    fit = learned(observations, fit_base(observations, Model()))
    hypotheses = list_hypotheses(rig, shipped_effects())
    (asked,) = (h for h in hypotheses if label in [n.label for n in h.names])
    models = {asked.label: Model().plus(asked.placed, asked.scales)}
    at_once = first_order_changes(observations, fit, [asked], models)
    gains = ExpectedGain(fit.posterior, observations.scatters, Marginal(fit))
    given = (observations, fit, models[asked.label], asked, gains)
    alone, shared = _Shown.of(*given), _Shown.of(*given, at_once[asked.label])
    assert alone is not None
    assert shared is not None
    np.testing.assert_allclose(shared.slope, alone.slope, atol=1e-6 * np.max(np.abs(alone.slope)))
    np.testing.assert_allclose(shared.before.values, alone.before.values, atol=1e-9)
    assert shared.least(9.0, 2.0) == pytest.approx(alone.least(9.0, 2.0), rel=1e-5)


def test_the_limit_of_an_effect_that_bends_predictions_is_that_of_the_fit_and_not_of_first_order() -> None:
    one = bent(0.0)
    one = replace(one, std=float(1 / np.sqrt(one.gains.change(one.slope).total)))
    limit, wanted = one.least(5.0, 2.0), one._wanted(5.0, 2.0, 1 / one.std)
    followed = one._followed(*one._moved(limit)[1:])  # type: ignore[arg-type]
    assert followed is not None
    assert one._gained(followed)[0] == pytest.approx(wanted, rel=0.12)
    assert limit < 0.5 * one.std * (np.sqrt(2 * wanted) + 1.28)
