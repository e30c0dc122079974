"""Modes that damping couples, against the eigenvalues of the first-order system."""

from __future__ import annotations

import numpy as np
import pytest
from imperfect_modes import chain

from ema_pipeline.effects.library import parse_effect
from ema_pipeline.mechanics.damped_modes import DampedModes
from ema_pipeline.mechanics.modes import complex_modes
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.rigs.planetary import planetary


@pytest.mark.parametrize(("coefficient", "close"), [(5.0, 1e-8), (50.0, 1e-6), (150.0, 1e-4), (800.0, 1e-9)])
def test_frequencies_and_ratios_are_those_of_the_first_order_system(coefficient: float, close: float) -> None:
    rig = chain()
    model = RigModel(rig, [parse_effect("damper@m2.z", rig)])
    x = model.start({"damper@m2.z.coefficient": coefficient})
    _, solution = model.modes(rig.configurations[0], x)
    assert solution is not None
    assert solution.damped is not None
    exact = complex_modes(model.system(rig.configurations[0], x))
    np.testing.assert_allclose(solution.frequency_hz, exact.frequency_hz, rtol=close)
    np.testing.assert_allclose(solution.damping_ratio, exact.damping_ratio, atol=10 * close)


def test_proportional_damping_couples_nothing() -> None:
    values = np.array([100.0, 400.0])
    assert DampedModes.of(values, np.eye(2), np.diag([0.2, 0.4]), np.zeros((2, 2))) is None


def test_two_equal_oscillators_of_which_one_is_damped_keep_their_frequency() -> None:
    """Uncoupled oscillators: λ = -c/2 ± i√(ω² - c²/4) for one, ±iω for the other, in whatever basis they are given."""
    omega, c, turn = 10.0, 2.0, np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    damping = turn.T @ np.diag([c, 1e-9]) @ turn
    found = DampedModes.of(np.array([omega**2, omega**2 * (1 + 1e-9)]), turn, damping, np.zeros((2, 2)))
    assert found is not None
    np.testing.assert_allclose(np.sort(found.damping_ratio), [0.0, c / 2 / omega], atol=1e-6)
    np.testing.assert_allclose(found.frequency_hz, omega / (2 * np.pi), rtol=1e-6)


def test_a_damped_rigid_body_leaves_the_modes_above_it_as_they_are() -> None:
    """Its pole is real; taken for one of a mode in the band it would be a mode that nobody measured."""
    values, damping = np.array([1.0, 100.0**2, 200.0**2]), np.full((3, 3), 8.0)
    found = DampedModes.of(values, np.eye(3), damping, np.zeros((3, 3)))
    assert found is not None
    assert found.frequency_hz[0] == pytest.approx(1 / (2 * np.pi), rel=1e-6)
    first_order = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag(values), -damping]])
    exact = np.linalg.eigvals(first_order)
    exact = exact[exact.imag > 1]
    np.testing.assert_allclose(found.frequency_hz[1:], np.sort(np.abs(exact)) / (2 * np.pi), rtol=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_modes_stay_finite_however_large_damping_is_that_a_search_tries(sign: float) -> None:
    values, damping = np.array([1.0, 100.0**2, 200.0**2]), sign * np.full((3, 3), 1e5)
    found = DampedModes.of(values, np.eye(3), damping, np.zeros((3, 3)))
    assert found is not None
    assert np.all(np.isfinite(found.poles))
    assert np.all(np.isfinite(found.shapes))


@pytest.mark.parametrize("coefficient", [5.0, 60.0])
def test_gyroscopic_coupling_parts_pairs_as_the_first_order_system_does(coefficient: float) -> None:
    rig = planetary()
    model = RigModel(rig, [parse_effect("gyroscopic@carrier", rig)])
    x = model.start({"gyroscopic@carrier.coefficient": coefficient})
    bare = RigModel(rig).modes("with_ring", RigModel(rig).start())[1]
    _, solution = model.modes("with_ring", x)
    assert solution is not None
    assert bare is not None
    exact = complex_modes(model.system("with_ring", x))
    band = exact.frequency_hz > 10
    np.testing.assert_allclose(
        np.sort(solution.frequency_hz[solution.frequency_hz > 10]),
        np.sort(exact.frequency_hz[band]),
        rtol=1e-6,
    )
    assert np.max(np.abs(solution.frequency_hz / bare.frequency_hz - 1)) > 1e-4 * coefficient / 5
