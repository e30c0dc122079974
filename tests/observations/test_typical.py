"""Sizes to expect of effects, from one motion and its force."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ema_pipeline.effects.base import EffectParameter, PlacedEffect
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.observations.typical import Typical

X, OMEGA, FORCE = 2e-3, 50.0, 30.0
TYPICAL = Typical(X, OMEGA, FORCE)


@pytest.mark.parametrize(
    ("unit", "motion"),
    [
        ("N", 1.0), ("N/m", X), ("N/m²", X**2), ("N/m³", X**3), ("N·s/m", X * OMEGA),
        ("N·s²/m²", (X * OMEGA) ** 2),
    ],
)  # fmt: skip
def test_a_size_times_its_motion_is_the_measured_force(unit: str, motion: float) -> None:
    size = TYPICAL.size(unit)
    assert size is not None
    assert size * motion == pytest.approx(FORCE)


def test_lengths_times_and_rates_are_those_of_the_motion() -> None:
    assert TYPICAL.size("m") == X
    assert TYPICAL.size("1/m") == pytest.approx(500.0)
    assert TYPICAL.size("s") == pytest.approx(0.02)
    assert TYPICAL.size("m/s") == pytest.approx(0.02 * 0.1)  # a fiftieth of the largest rate
    assert TYPICAL.size("°") is None


def scaled(*parameters: EffectParameter) -> tuple[EffectParameter, ...]:
    effect = replace(shipped_effects()["spring"], parameters=parameters)
    return TYPICAL.scaled(PlacedEffect(effect, "sun")).effect.parameters


def test_priors_are_half_of_the_measured_force_and_fits_start_from_a_tenth() -> None:
    both_ways = EffectParameter("k", "N/m", 0.0, 1.0, 1.0, -1e9, 1e9)
    loss = replace(both_ways, null=100.0, start=0.0)
    first, second = scaled(both_ways, loss)
    assert (first.start, first.scale) == pytest.approx((1500.0, 7500.0))
    assert (second.null, second.start, second.scale) == pytest.approx((100.0, 100.0 - 1500.0, 7500.0))


def test_a_size_that_cannot_be_zero_starts_from_the_motion_within_its_range() -> None:
    rate = EffectParameter("rate", "m/s", 1.0, 1.0, 1.0, 1e-4, 1e-2)
    assert scaled(rate) == (replace(rate, null=0.002, start=0.002),)
    assert scaled(replace(rate, maximum=1e-3))[0].start == 1e-3


def test_a_size_whose_unit_does_not_tell_stays_as_it_is() -> None:
    exponent = EffectParameter("n", "1", 0.0, 1.0, 1.0, 0.0, 9.0)
    assert scaled(exponent) == (exponent,)
