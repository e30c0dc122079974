"""Mechanics against textbook results and scipy."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Gyroscopic, Mass, Spring, difference
from ema_pipeline.mechanics.frf import accelerance, receptance
from ema_pipeline.mechanics.modes import complex_modes, damping_ratios, normal_modes, total_damping
from ema_pipeline.mechanics.sampling import anti_alias
from ema_pipeline.mechanics.system import LinearSystem, sensor_row, sensor_rows
from ema_pipeline.mechanics.time_response import time_response


def chain(n: int = 4, *, grounded: bool = True, damping: float = 0.0, modal: float = 0.0) -> Assembly:
    dofs = tuple(f"m{i}.x" for i in range(n))
    elements: list = [Mass(f"mass {i}", {d: 1.0}, 1.0 + 0.3 * i) for i, d in enumerate(dofs)]
    if grounded:
        elements.append(Spring("ground", {dofs[0]: 1.0}, 9e4))
    for i, (a, b) in enumerate(pairwise(dofs)):
        elements.append(Spring(f"spring {i}", difference({b: 1.0}, {a: 1.0}), 1e5 * (1 + 0.2 * i)))
    if damping:
        elements.append(Damper("dashpot", {dofs[-1]: 1.0}, damping))
    return Assembly(dofs, tuple(elements), {"tip.x": {dofs[-1]: 1.0}}, modal)


def random_system(seed: int, n: int = 6) -> LinearSystem:
    rng = np.random.default_rng(seed)
    a, b, c = (rng.standard_normal((n, n)) for _ in range(3))
    return LinearSystem(
        dofs=tuple(f"p{i}.x" for i in range(n)),
        mass=a @ a.T / n + np.eye(n),
        stiffness=1e5 * (b @ b.T / n + 0.2 * np.eye(n)),
        damping=2.0 * (c @ c.T) / n,
        structural=np.zeros((n, n)),
    )


def test_two_equal_masses_have_the_textbook_frequencies() -> None:
    m, k = 2.0, 3e4
    rows = {"a.x": 1.0}, {"b.x": 1.0}
    system = Assembly(
        ("a.x", "b.x"),
        (
            Mass("ma", rows[0], m),
            Mass("mb", rows[1], m),
            Spring("left", rows[0], k),
            Spring("middle", difference(*rows), k),
            Spring("right", rows[1], k),
        ),
    ).system()
    frequency_hz, shapes = normal_modes(system)
    np.testing.assert_allclose(frequency_hz, np.sqrt([k / m, 3 * k / m]) / (2 * np.pi), rtol=1e-12)
    np.testing.assert_allclose(np.abs(shapes), 1 / np.sqrt(2 * m), rtol=1e-12)
    np.testing.assert_allclose(shapes.T @ system.mass @ shapes, np.eye(2), atol=1e-12)


def test_free_chain_has_its_rigid_body_mode_at_exactly_zero() -> None:
    frequency_hz, shapes = normal_modes(chain(5, grounded=False).system())
    assert frequency_hz[0] == 0.0
    assert np.all(frequency_hz[1:] > 1.0)
    np.testing.assert_allclose(shapes[:, 0], shapes[0, 0], rtol=1e-9)


def test_a_coordinate_without_mass_is_named() -> None:
    assembly = Assembly(
        ("a.x", "b.x"), (Mass("m", {"a.x": 1.0}, 1.0), Spring("k", {"a.x": 1, "b.x": -1}, 1.0))
    )
    with pytest.raises(EmaError, match=r"b\.x.*mass above 0"):
        normal_modes(assembly.system())


def test_negative_stiffness_is_refused_with_the_place() -> None:
    assembly = chain(3).add(Spring("bad", {"m2.x": 1.0}, -1e6))
    with pytest.raises(EmaError, match=r"negative around 'm2\.x'"):
        normal_modes(assembly.system())


def test_unknown_dof_is_refused_with_a_hint() -> None:
    system = chain(3).system()
    with pytest.raises(EmaError, match=r"did you mean 'm1\.x'"):
        sensor_row(system, Dof("m1", "xx"))
    with pytest.raises(EmaError, match="unknown dof"):
        chain(3).add(Spring("s", {"nowhere.x": 1.0}, 1.0)).system()


def test_sensor_rows_carry_the_sign_and_derived_places() -> None:
    system = chain(3).system()
    np.testing.assert_array_equal(sensor_row(system, Dof("m1", "x", -1)), [0, -1, 0])
    np.testing.assert_array_equal(sensor_row(system, Dof("tip", "x")), [0, 0, 1])


def test_poles_solve_the_quadratic_eigenproblem() -> None:
    system = dataclasses.replace(random_system(1), modal_damping_ratio=0.02)
    modes = complex_modes(system)
    assert len(modes.poles) == 6
    c = total_damping(system)
    for s, phi in zip(modes.poles, modes.shapes.T, strict=True):
        residual = (s**2 * system.mass + s * c + system.stiffness) @ phi
        assert np.linalg.norm(residual) < 1e-9 * np.linalg.norm(system.stiffness @ phi)


def test_complex_modes_rebuild_the_receptance_with_viscous_damping() -> None:
    system = random_system(2)
    modes = complex_modes(system)
    frequency_hz = np.linspace(1.0, 150.0, 40)
    jw = 2j * np.pi * frequency_hz
    rebuilt = np.zeros((6, 6, 40), dtype=complex)
    for s, phi in zip(modes.poles, modes.shapes.T, strict=True):
        residue = np.outer(phi, phi) / (2j * s.imag)
        rebuilt += residue[..., None] / (jw - s) + residue.conj()[..., None] / (jw - s.conj())
    exact = receptance(system, frequency_hz, np.eye(6), np.eye(6))
    np.testing.assert_allclose(rebuilt, exact, rtol=1e-8, atol=1e-10 * np.abs(exact).max())


def test_modal_damping_gives_every_mode_its_ratio() -> None:
    system = chain(4, modal=0.013).system()
    modes = complex_modes(system)
    np.testing.assert_allclose(modes.damping_ratio, 0.013, rtol=1e-9)
    np.testing.assert_allclose(modes.frequency_hz, normal_modes(system)[0], rtol=1e-9)
    np.testing.assert_allclose(damping_ratios(system, *normal_modes(system)), 0.013, rtol=1e-12)


def test_loss_factor_of_a_single_spring_gives_half_of_it_as_damping_ratio() -> None:
    eta = 0.04
    row = {"a.x": 1.0}
    system = Assembly(("a.x",), (Mass("m", row, 2.0), Spring("k", row, 8e4, eta))).system()
    pole = complex_modes(system).poles[0]
    assert pole == pytest.approx(1j * np.sqrt(4e4 * (1 + 1j * eta)), rel=1e-12)
    assert damping_ratios(system, *normal_modes(system))[0] == pytest.approx(eta / 2, rel=1e-12)
    f = np.array([10.0, 31.0, 40.0])
    expected = 1 / (8e4 * (1 + 1j * eta) - (2 * np.pi * f) ** 2 * 2.0)
    np.testing.assert_allclose(receptance(system, f, np.eye(1), np.eye(1))[0, 0], expected, rtol=1e-12)


def test_the_converters_filter_is_flat_to_its_rate_over_2_56_and_shuts_at_half_the_rate() -> None:
    flat, shut = 1000 / 2.56, 500.0
    asked = np.array([0.0, 100.0, flat, 0.5 * (flat + shut), shut, 600.0])
    np.testing.assert_allclose(anti_alias(asked, 1000.0), [1.0, 1.0, 1.0, 0.5, 0.0, 0.0], atol=1e-12)
    falling = np.diff(anti_alias(np.linspace(flat, shut, 50), 1000.0))
    assert np.all(falling < 0)


def test_gyroscopic_coupling_turns_the_velocity_of_a_free_mass_from_x_to_y() -> None:
    """m·ẍ = -c·ẏ, m·ÿ = c·ẋ: a circle at c/m, run through from +x to +y."""
    rows = {"a.x": 1.0}, {"a.y": 1.0}
    system = Assembly(
        ("a.x", "a.y"),
        (*(Mass(f"m{i}", row, 2.0) for i, row in enumerate(rows)), Gyroscopic("g", *rows, 6.0)),
    ).system()
    time = 0.4
    turn = scipy.linalg.expm(-np.linalg.solve(system.mass, system.damping) * time)
    np.testing.assert_allclose(turn @ [1.0, 0.0], [np.cos(3.0 * time), np.sin(3.0 * time)], atol=1e-12)


def test_gyroscopic_coupling_parts_a_pair_into_forward_and_backward_whirl() -> None:
    m, k, g = 1.5, 6e4, 30.0
    x, y = {"r.x": 1.0}, {"r.y": 1.0}
    system = Assembly(
        ("r.x", "r.y"),
        (
            Mass("mx", x, m),
            Mass("my", y, m),
            Spring("kx", x, k),
            Spring("ky", y, k),
            Gyroscopic("g", x, y, g),
        ),
    ).system()
    modes = complex_modes(system)
    # m ω² ∓ g ω - k = 0, the textbook whirl speeds
    root = np.sqrt(g**2 + 4 * m * k)
    np.testing.assert_allclose(modes.poles.imag, [(root - g) / (2 * m), (root + g) / (2 * m)], rtol=1e-10)
    np.testing.assert_allclose(modes.damping_ratio, 0.0, atol=1e-12)
    ratio = modes.shapes[1] / modes.shapes[0]
    np.testing.assert_allclose(np.sort(ratio.imag), [-1.0, 1.0], rtol=1e-9)
    assert np.all(modes.damping_ratio >= 0)


def test_rigid_body_mode_stays_at_zero_beside_a_damper_between_two_bodies() -> None:
    assembly = chain(3, grounded=False).add(Damper("between", {"m0.x": 1.0, "m1.x": -1.0}, 4.0))
    modes = complex_modes(assembly.system())
    assert modes.poles[0] == 0
    assert len(modes.poles) == 3
    assert np.all(modes.damping_ratio[1:] > 0)


def test_frf_by_modes_equals_frf_by_inversion() -> None:
    system = chain(4, modal=0.01).system()
    explicit = dataclasses.replace(system, damping=total_damping(system), modal_damping_ratio=0.0)
    f = np.linspace(0.5, 120.0, 200)
    rows = np.eye(4)
    np.testing.assert_allclose(
        receptance(system, f, rows, rows), receptance(explicit, f, rows, rows), rtol=1e-8, atol=1e-16
    )


def test_accelerance_of_a_free_body_at_zero_is_one_over_its_mass() -> None:
    system = chain(3, grounded=False, modal=0.01).system()
    rows = np.eye(3)
    value = accelerance(system, np.array([0.0, 10.0]), rows, rows)[0, 0, 0]
    assert value == pytest.approx(1 / (1.0 + 1.3 + 1.6), rel=1e-6)
    with pytest.raises(EmaError, match="infinite at 0 Hz"):
        receptance(system, np.array([0.0, 10.0]), rows, rows)


def test_reciprocity_holds_without_and_fails_with_gyroscopic_coupling() -> None:
    f = np.array([20.0, 33.0])
    plain = chain(3, damping=3.0)
    rows = np.eye(3)
    h = receptance(plain.system(), f, rows, rows)
    np.testing.assert_allclose(h, h.transpose(1, 0, 2), rtol=1e-10)
    skew = plain.add(Gyroscopic("g", {"m0.x": 1.0}, {"m2.x": 1.0}, 60.0))
    h = receptance(skew.system(), f, rows, rows)
    assert np.max(np.abs(h - h.transpose(1, 0, 2))) > 0.05 * np.max(np.abs(h)), "a skew term breaks it"


def test_time_response_equals_lsim_with_a_ramped_force() -> None:
    system = random_system(3, n=4)
    rate, n = 2000.0, 1500
    force = np.random.default_rng(0).standard_normal((2, n))
    inputs = sensor_rows(system, (Dof("p0", "x"), Dof("p2", "x")))
    response = time_response(system, rate, force, np.eye(4), inputs)
    minv = np.linalg.inv(system.mass)
    a = np.block([[np.zeros((4, 4)), np.eye(4)], [-minv @ system.stiffness, -minv @ system.damping]])
    b = np.vstack([np.zeros((4, 2)), minv @ inputs.T])
    _, _, x = scipy.signal.lsim((a, b, np.eye(8), np.zeros((8, 2))), force.T, np.arange(n) / rate)
    scale = np.abs(x).max(axis=0)
    np.testing.assert_allclose(response.displacement.T / scale[:4], x[:, :4] / scale[:4], atol=1e-9)
    np.testing.assert_allclose(response.velocity.T / scale[4:], x[:, 4:] / scale[4:], atol=1e-9)


def test_time_response_equals_a_fine_integration_with_a_free_body() -> None:
    system = chain(3, grounded=False, damping=2.0, modal=0.01).system()
    rate, n = 1000.0, 200
    t = np.arange(n) / rate
    force = np.where(t < 0.01, np.sin(np.pi * t / 0.01), 0.0)
    row = np.eye(3)[:1]
    response = time_response(system, rate, force, np.eye(3), row)
    c, minv = total_damping(system), np.linalg.inv(system.mass)

    def rhs(time: float, state: np.ndarray) -> np.ndarray:
        f = row[0] * np.interp(time, t, force)
        return np.concatenate([state[3:], minv @ (f - c @ state[3:] - system.stiffness @ state[:3])])

    exact = scipy.integrate.solve_ivp(
        rhs, (0, t[-1]), np.zeros(6), t_eval=t, rtol=1e-9, atol=1e-12, max_step=1 / rate
    ).y
    np.testing.assert_allclose(response.displacement, exact[:3], atol=1e-6 * np.abs(exact[:3]).max())
    np.testing.assert_allclose(response.velocity, exact[3:], atol=1e-6 * np.abs(exact[3:]).max())


def test_time_response_refuses_a_loss_factor() -> None:
    row = {"a.x": 1.0}
    system = Assembly(("a.x",), (Mass("m", row, 2.0), Spring("k", row, 8e4, 0.1))).system()
    with pytest.raises(EmaError, match="loss factor"):
        time_response(system, 100.0, np.zeros((1, 10)), np.eye(1), np.eye(1))


def test_a_mode_slower_than_one_radian_per_second_has_its_damping_ratio() -> None:
    row = {"a.x": 1.0}
    elements = (Mass("m", row, 1.0), Spring("k", row, 0.04), Damper("c", row, 0.02))
    modes = complex_modes(Assembly(("a.x",), elements).system())
    assert modes.damping_ratio == pytest.approx([0.05])
    assert modes.frequency_hz == pytest.approx([0.2 / (2 * np.pi)])


def test_a_rigid_body_mode_is_free_of_damping_and_mass_normalised() -> None:
    rows = {"a.x": 1.0}, {"b.x": 1.0}
    elements = (Mass("ma", rows[0], 2.0), Mass("mb", rows[1], 3.0), Spring("k", difference(*rows), 1e4))
    modes = complex_modes(Assembly(("a.x", "b.x"), elements).system())
    assert modes.damping_ratio[0] == 0.0
    assert np.abs(modes.shapes[:, 0]) == pytest.approx([1 / np.sqrt(5)] * 2)


@pytest.mark.parametrize("which", ["mass", "stiffness"])
def test_the_coordinate_of_a_number_that_is_none_is_named(which: str) -> None:
    system = chain(3).system()
    matrix = getattr(system, which).copy()
    matrix[2, 2] = np.nan
    with pytest.raises(EmaError, match=f"{which} at 'm2.x' is not a finite number"):
        normal_modes(dataclasses.replace(system, **{which: matrix}))


def test_the_coordinate_without_mass_and_that_of_a_negative_stiffness_are_named() -> None:
    system = chain(3).system()
    mass, stiffness = system.mass.copy(), system.stiffness.copy()
    mass[1, 1] = 0.0
    with pytest.raises(EmaError, match=r"mass matrix is not positive around 'm1\.x'"):
        normal_modes(dataclasses.replace(system, mass=mass))
    stiffness[2, 2] -= 1e6
    with pytest.raises(EmaError, match=r"stiffness is negative around 'm2\.x'"):
        normal_modes(dataclasses.replace(system, stiffness=stiffness))


def test_the_frequency_at_which_a_free_body_has_no_receptance_is_named() -> None:
    row = {"a.x": 1.0}
    system = Assembly(("a.x",), (Mass("m", row, 1.0),)).system()
    with pytest.raises(EmaError, match=r"\b0 Hz"):
        receptance(system, np.array([5.0, 0.0]), np.eye(1), np.eye(1))
