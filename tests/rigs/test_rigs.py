"""Rigs against published frequencies, and rig files."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from lin_parker import LIN_PARKER, ROTATIONAL, TRANSLATIONAL

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_row
from ema_pipeline.rigs import load_rig, model_modes, rig_names
from ema_pipeline.rigs.frame import frame
from ema_pipeline.rigs.planetary import planetary


def frequencies(rig, configuration, values=None, family=None) -> list[float]:
    modes = model_modes(rig, configuration, values)
    return [m.frequency_hz for m in modes if family is None or m.family == family]


def test_lin_and_parker_frequencies_come_out_with_their_multiplicities() -> None:
    rig = planetary(3)
    np.testing.assert_allclose(frequencies(rig, "with_ring", LIN_PARKER, "rotational"), ROTATIONAL, atol=0.05)
    pairs = np.repeat(TRANSLATIONAL, 2)
    np.testing.assert_allclose(frequencies(rig, "with_ring", LIN_PARKER, "translational"), pairs, atol=0.05)
    assert frequencies(rig, "with_ring", LIN_PARKER, "rigid body") == [0.0]
    assert len(model_modes(rig, "with_ring", LIN_PARKER)) == 18


@pytest.mark.parametrize("planets", [3, 4, 5, 6])
def test_families_have_the_sizes_of_the_theory(planets: int) -> None:
    modes = model_modes(planetary(planets), "with_ring", LIN_PARKER)
    families = [m.family for m in modes]
    assert families.count("rotational") + families.count("rigid body") == 6
    assert families.count("translational") == 12
    assert families.count("planet") == 3 * (planets - 3)


@pytest.mark.parametrize("planets", [4, 6])
def test_planet_modes_repeat_and_do_not_depend_on_the_number_of_planets(planets: int) -> None:
    planet = frequencies(planetary(planets), "with_ring", LIN_PARKER, "planet")
    np.testing.assert_allclose(planet, np.repeat([1808.2, 5963.8, 6981.7], planets - 3), atol=0.1)


def test_shapes_of_each_family_move_what_the_theory_says() -> None:
    rig = planetary(4)
    system = rig.system("with_ring", LIN_PARKER)
    central_turn = [system.dofs.index(f"{b}.u") for b in ("carrier", "ring", "sun")]
    central_shift = [system.dofs.index(f"{b}.{d}") for b in ("carrier", "ring", "sun") for d in "xy"]
    for mode in model_modes(rig, "with_ring", LIN_PARKER):
        if mode.family in ("translational", "planet"):
            np.testing.assert_allclose(mode.shape[central_turn], 0, atol=1e-6)
        if mode.family in ("rotational", "planet", "rigid body"):
            np.testing.assert_allclose(mode.shape[central_shift], 0, atol=1e-6)


@pytest.mark.parametrize("planets", [2, 3, 5])
def test_modes_that_coincide_by_accident_are_still_sorted_into_families(planets: int) -> None:
    rig = planetary(planets)
    system = rig.system("with_ring", LIN_PARKER)
    _, shapes = normal_modes(system)
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.standard_normal((shapes.shape[1],) * 2))
    families, rotated = rig.classify(system, np.full(shapes.shape[1], 100.0), shapes @ turn)
    assert families.count("rotational") == 6
    assert families.count("planet") == 3 * max(planets - 3, 0)
    np.testing.assert_allclose(rotated.T @ system.mass @ rotated, np.eye(len(families)), atol=1e-9)


def test_default_rig_gives_the_seeds_predictions() -> None:
    rig = load_rig("planetary")
    case1 = frequencies(rig, "no_ring")
    for expected in (51.1, 106.7, 113.9, 1395.0):
        assert min(abs(f - expected) for f in case1) < 0.06
    case2 = frequencies(rig, "with_ring", {"ring_planet_mesh_stiffness": 1.5e7})
    for expected in (46.2, 106.0, 310.8, 965.2):
        assert min(abs(f - expected) for f in case2) < 0.06


def error_over_stiffness(configuration: str, measured: list[float], stiffness, values) -> np.ndarray:
    """The seed's error function (its Eq. 10) with nearest-frequency pairing."""
    rig = load_rig("planetary")
    errors = []
    for k in stiffness:
        model = normal_modes(rig.system(configuration, values(k)))[0]
        model = model[model > 0]
        nearest = [model[np.argmin(np.abs(model - f))] for f in measured]
        errors.append(np.sum(((np.array(measured) - nearest) / nearest) ** 2))
    return np.array(errors)


def test_three_low_modes_of_the_first_case_do_not_determine_the_mesh_stiffness() -> None:
    k = np.logspace(6, 9, 601)
    measured = [62.5, 85.7, 134.0, 1097.0]
    four = error_over_stiffness("no_ring", measured, k, lambda x: {"sun_planet_mesh_stiffness": x})
    assert k[np.argmin(four)] == pytest.approx(5.5e6, rel=0.02)
    three = error_over_stiffness("no_ring", measured[:3], k, lambda x: {"sun_planet_mesh_stiffness": x})
    assert three.max() / three.min() - 1 < 0.01


def test_second_case_has_its_minimum_far_below_the_printed_stiffness() -> None:
    k = np.logspace(6, 7.5, 121)
    error = error_over_stiffness(
        "with_ring", [47.5, 90.66, 515.0, 1117.0], k, lambda x: {"ring_planet_mesh_stiffness": x}
    )
    assert 1.6e6 < k[np.argmin(error)] < 1.9e6


def test_bare_ring_on_ten_times_softer_bearing_gives_the_printed_98_hz() -> None:
    # f = √(k/m)/2π of the ring alone; Table I's 1.64e7 N/m would give 311 Hz.
    rig = load_rig("planetary")
    soft = frequencies(
        rig,
        "with_ring",
        {
            "ring_bearing_stiffness": 1.64e6,
            "sun_planet_mesh_stiffness": 1e6,
            "ring_planet_mesh_stiffness": 1e6,
        },
    )
    assert min(abs(f - 98.3) for f in soft) < 3.0


def test_modal_damping_is_one_percent_in_every_elastic_mode() -> None:
    for mode in model_modes(load_rig("planetary"), "with_ring"):
        assert mode.damping_ratio == pytest.approx(0.0 if mode.frequency_hz == 0 else 0.01)
        assert mode.complex_shape is None


def test_planet_sensors_in_x_and_y_follow_the_planets_position() -> None:
    system = planetary(4).system("no_ring")
    # Planet 2 of 4 sits at 90°: its x is -η, its y is ζ.
    x, y = sensor_row(system, Dof("planet2", "x")), sensor_row(system, Dof("planet2", "y"))
    assert x[system.dofs.index("planet2.eta")] == pytest.approx(-1.0)
    assert y[system.dofs.index("planet2.zeta")] == pytest.approx(1.0)
    assert abs(x[system.dofs.index("planet2.zeta")]) < 1e-12
    rig = planetary(4)
    assert rig.knows("no_ring", Dof("planet4", "y"))
    assert not rig.knows("no_ring", Dof("ring", "x"))
    assert rig.knows("with_ring", Dof("ring", "x"))


def test_rigid_rotation_of_all_gears_in_mesh_strains_no_spring() -> None:
    # Kinematics by hand: carrier turns by 1 at the planets' circle, ring held, sun and planets roll.
    system = planetary(3).system("with_ring", {"pressure_angle_deg": 20.0})
    u = dict.fromkeys(system.dofs, 0.0)
    alpha = np.deg2rad(20.0)
    u["carrier.u"] = 1.0
    for n in (1, 2, 3):
        u[f"planet{n}.eta"] = 1.0
        u[f"planet{n}.u"] = -np.cos(alpha)  # ring mesh: -η cos α - u_p = 0
    u["sun.u"] = 2 * np.cos(alpha)  # sun mesh: u_s - η cos α + u_p = 0
    x = np.array([u[d] for d in system.dofs])
    assert abs(x @ system.stiffness @ x) < 1e-6 * 1e7


def test_used_parameters_leave_the_ring_out_where_there_is_none() -> None:
    rig = load_rig("planetary")
    assert "ring_planet_mesh_stiffness" not in rig.used("no_ring")
    assert "ring_planet_mesh_stiffness" in rig.used("with_ring")
    for name in set(rig.parameters) - set(rig.used("no_ring")):
        moved = rig.system("no_ring", {name: 2 * rig.parameters[name].value})
        np.testing.assert_array_equal(moved.stiffness, rig.system("no_ring").stiffness)


def test_free_parameters_are_the_two_mesh_stiffnesses() -> None:
    free = {n: (p.minimum, p.maximum) for n, p in load_rig("planetary").parameters.items() if p.free}
    assert free == {
        "sun_planet_mesh_stiffness": (1e6, 1e9),
        "ring_planet_mesh_stiffness": (1e6, 1e9),
    }


def test_frame_has_the_closed_form_frequencies_of_a_uniform_shear_building() -> None:
    n, m, k = 4, 5.0, 2e5
    expected = np.sqrt(k / m) / np.pi * np.sin((2 * np.arange(1, n + 1) - 1) * np.pi / (2 * (2 * n + 1)))
    np.testing.assert_allclose(frequencies(frame(n), "default"), expected, rtol=1e-10)


def test_rigs_can_be_sent_to_another_process() -> None:
    for name in rig_names():
        rig = load_rig(name)
        again = pickle.loads(pickle.dumps(rig))
        configuration = rig.configurations[0]
        np.testing.assert_array_equal(
            again.system(configuration).stiffness, rig.system(configuration).stiffness
        )


def test_unknown_names_come_with_a_hint() -> None:
    rig = load_rig("planetary")
    with pytest.raises(EmaError, match="did you mean 'with_ring'"):
        rig.system("with_rign")
    with pytest.raises(EmaError, match="did you mean 'sun_mass'"):
        rig.system("with_ring", {"sun_mas": 2.0})
    with pytest.raises(EmaError, match="did you mean 'planetary'"):
        load_rig("planetry")
