"""Larger motions against smaller lengths, forces and rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulate_amplitude import observed, simulated_hits, true_assembly

from ema_pipeline.mechanics.laws import (
    AT_LARGER_MOTION,
    BoucWen,
    DryFriction,
    Nonlinear,
    PartingSpring,
    PolynomialSpring,
)
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.observations.hit_modes import Linear, changed_modes
from ema_pipeline.observations.larger_motions import as_larger_motions

LARGER = 1.7
HUB = {"hub.x": 1.0}


@pytest.mark.parametrize(
    ("element", "smaller"),
    [
        pytest.param(
            PolynomialSpring("c", HUB, 1e6, 3e10),
            PolynomialSpring("c", HUB, LARGER * 1e6, LARGER**2 * 3e10),
            marks=pytest.mark.slow,
        ),
        (DryFriction("f", HUB, 0.3, 0.01), DryFriction("f", HUB, 0.3 / LARGER, 0.01 / LARGER)),
        pytest.param(
            PartingSpring("p", HUB, 2e5, preload=2e-4, gap=5e-4),
            PartingSpring("p", HUB, 2e5, preload=2e-4 / LARGER, gap=5e-4 / LARGER),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_larger_motions_are_as_smaller_lengths_forces_and_rates(
    element: Nonlinear, smaller: Nonlinear
) -> None:
    (data,) = observed(simulated_hits([], noise=1e-4)).hits
    values, shapes = eigen_solution(true_assembly().system())
    stretch = element_rows(true_assembly(), [element]) @ shapes
    motion = np.nan_to_num(data.motion)
    linear = Linear.of(data, stretch, np.arange(len(values)), values, motion)
    found = changed_modes(data, [element], replace(linear, displacement=LARGER * motion))
    assert np.any(found)
    np.testing.assert_allclose(changed_modes(data, [smaller], linear), found, rtol=1e-9, atol=1e-12)
    assert element.law is not None
    assert smaller.law is not None
    powers = np.array(AT_LARGER_MOTION[element.law[0]])
    np.testing.assert_allclose(smaller.law[1:], np.float_power(LARGER, powers) * element.law[1:], rtol=1e-12)


def friction(force: float, velocity: float) -> list[Nonlinear]:
    return [DryFriction(f"f{a}", {f"hub.{a}": 1.0}, force, velocity) for a in "xy"]


def test_friction_of_smaller_force_at_a_smaller_rate_is_as_larger_motions() -> None:
    step = 1e-6
    changed = [friction(0.5 + step, 0.01), friction(0.5, 0.01 * np.exp(1.2 * step))]
    found = as_larger_motions(friction(0.5, 0.01), changed, [step, step])
    np.testing.assert_allclose(found, [-0.5, -1 / 1.2], rtol=1e-5)


def test_what_sizes_alone_cannot_do_is_none() -> None:
    step = 1e-6
    one, other = friction(0.5, 0.01), friction(0.5 + step, 0.01)
    assert as_larger_motions(one, [other], [step]) is None  # the velocity stays
    fixed = PolynomialSpring("k", HUB, cubic=1e9)
    assert as_larger_motions([fixed], [], []) is None
    assert as_larger_motions([*one, fixed], [[*other, fixed]], [step]) is None
    own = BoucWen("b", HUB, 1.0, 100.0, 0.5)
    assert as_larger_motions([own], [[replace(own, limit=1.0 + step)]], [step]) is None
    assert as_larger_motions([], [one], [step]) is None  # an element that is not there at no size


def test_a_gap_without_end_is_as_wide_for_larger_motions() -> None:
    step = 1e-6
    teeth = PartingSpring("p", HUB, 2e5, preload=2e-4)
    found = as_larger_motions([teeth], [[replace(teeth, preload=2e-4 * np.exp(1.2 * step))]], [step])
    np.testing.assert_allclose(found, [-1 / 1.2], rtol=1e-5)
