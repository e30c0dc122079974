"""Nonlinear elements in motion of several frequencies: equivalent stiffness and offset."""

from __future__ import annotations

import numpy as np
import pytest

from ema_pipeline.mechanics.equivalent import Motions, _phases, settled_offsets
from ema_pipeline.mechanics.harmonic import describing_function
from ema_pipeline.mechanics.laws import BoucWen, DryFriction, Nonlinear, PartingSpring, PolynomialSpring

ROW = {"x": 1.0}
OMEGA = np.array([300.0, 470.0, 1100.0])


def single(amplitude: float, omega: float = 300.0) -> Motions:
    return Motions(np.array([[amplitude]]), np.array([omega]))


def test_a_cubic_spring_under_one_sine_and_under_several() -> None:
    k3, a = 2e12, np.array([[2e-5, 1e-5, 3e-6]])
    cubic = PolynomialSpring("cubic", ROW, cubic=k3)
    alone = single(2e-5).stiffness(cubic, np.zeros(1))[0, 0]
    assert alone == pytest.approx(0.75 * k3 * 4e-10, rel=1e-9)
    together = Motions(a, OMEGA).stiffness(cubic, np.zeros(1))[0]
    expected = k3 * (1.5 * np.sum(a**2) - 0.75 * a[0] ** 2)
    np.testing.assert_allclose(together.real, expected, rtol=0.02)
    assert np.all(np.abs(together.imag) < 0.05 * expected)


def test_dry_friction_is_a_damper_that_falls_with_the_amplitude() -> None:
    friction = DryFriction("friction", ROW, 1.5, 1e-5)
    for amplitude in (1e-4, 1e-3):
        found = single(amplitude).stiffness(friction, np.zeros(1))[0, 0]
        assert found.imag == pytest.approx(4 * 1.5 / (np.pi * amplitude), rel=0.04)
        assert abs(found.real) < 1e-3 * found.imag


@pytest.mark.parametrize(
    "element",
    [
        PartingSpring("mesh", ROW, 1e7, preload=1e-6, gap=1e-4),
        PartingSpring("mesh", ROW, 1e7, preload=0.0, gap=2e-6),
        DryFriction("friction", ROW, 1.0, 1e-3),
        BoucWen("wires", ROW, 5.0, 1e5, 0.6),
    ],
    ids=lambda e: e.name,
)
def test_one_sine_agrees_with_the_describing_function(element: Nonlinear) -> None:
    amplitude, omega = 4e-6, 900.0
    whole = describing_function(element, amplitude, omega)
    beside = whole - element.tangent_stiffness - 1j * omega * element.tangent_damping
    found = single(amplitude, omega).stiffness(element, np.zeros(1))[0, 0]
    assert abs(found - beside) < 0.05 * max(abs(beside), abs(whole))


def test_a_quadratic_spring_pushes_the_mean_aside_and_softens() -> None:
    k2, a, flexibility = 3e8, 2e-5, 1e-6
    spring = PolynomialSpring("quadratic", ROW, quadratic=k2)
    motion = single(a)
    offset = settled_offsets([spring], [motion], np.array([[flexibility]]))
    assert offset[0, 0] == pytest.approx(-flexibility * k2 * a**2 / 2, rel=0.05)
    assert motion.stiffness(spring, offset[0])[0, 0].real == pytest.approx(2 * k2 * offset[0, 0], rel=1e-6)


def test_teeth_that_never_part_change_nothing() -> None:
    mesh = PartingSpring("mesh", ROW, 1e7, preload=1e-3, gap=1e-4)
    motion = Motions(np.array([[2e-5, 1e-5, 3e-6], [0.0, 0.0, 0.0]]), OMEGA)
    assert not np.any(settled_offsets([mesh], [motion], np.eye(1) * 1e-7))
    assert not np.any(motion.stiffness(mesh, np.zeros(2)))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 30])
def test_phases_have_exact_first_and_second_moments(count: int) -> None:
    waves = np.exp(1j * _phases(count))
    sets = waves.shape[1]
    assert sets > 2 * count
    np.testing.assert_allclose(waves.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(waves @ waves.conj().T / sets, np.eye(count), atol=1e-12)
    np.testing.assert_allclose(waves @ waves.T / sets, 0, atol=1e-12)


def test_frequencies_without_motion_change_nothing() -> None:
    teeth = PartingSpring("teeth", ROW, 1e7, preload=1e-6, gap=1e-5)
    alone = single(3e-6).stiffness(teeth, np.zeros(1))[0, 0]
    beside = Motions(np.array([[3e-6, 0.0, 0.0]]), OMEGA).stiffness(teeth, np.zeros(1))[0]
    assert beside[0] == pytest.approx(alone, rel=1e-6)
    assert np.all(np.isfinite(beside))
    assert beside[1:].tolist() == [0.0, 0.0]
