"""The torsional gearbox and the isolator rig against limits known by hand and against the planetary rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ema_pipeline.diagnose.diagnosis import diagnose
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.dof import Dof
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.harmonic import harmonic_response
from ema_pipeline.mechanics.modes import complex_modes, normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.observations.mode_data import prepare
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.report.shapes import missing_words
from ema_pipeline.reproduce.gearbox import measure
from ema_pipeline.rigs import drawing_of, load_rig, model_modes
from ema_pipeline.rigs.drawing import Motion
from ema_pipeline.rigs.gearbox import default_parameters, gearbox
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.simulate import simulate_campaign

GEARBOX = load_rig("gearbox")


@pytest.mark.parametrize("planets", [2, 3, 4, 6])
def test_gearbox_has_one_rigid_body_two_rotational_and_planet_modes(planets: int) -> None:
    modes = model_modes(gearbox(planets), "default")
    families = [m.family for m in modes]
    assert families.count("rigid body") == 1
    assert families.count("rotational") == 2
    assert families.count("planet") == planets - 1
    p = default_parameters()
    alone = np.sqrt(
        (p["sun_planet_mesh_stiffness"].value + p["ring_planet_mesh_stiffness"].value)
        / p["planet_inertia"].value
    ) / (2 * np.pi)
    for m in modes:
        if m.family == "planet":
            assert m.frequency_hz == pytest.approx(alone, rel=1e-9)


def test_rotational_modes_are_those_of_the_reduced_three_by_three_system() -> None:
    p = {n: q.value for n, q in default_parameters().items()}
    k, c, n = p["sun_planet_mesh_stiffness"], np.cos(np.deg2rad(20)), 3
    # Sun, carrier, and all planets alike: linear equations of the source, summed over the planets.
    stiffness = k * n * np.array([[1, -c, 1], [-c, 2 * c**2, 0], [1, 0, 2]])
    mass = np.diag([p["sun_inertia"], p["carrier_inertia"], n * p["planet_inertia"]])
    expected = np.sqrt(np.abs(np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real))) / (
        2 * np.pi
    )
    found = [m.frequency_hz for m in model_modes(GEARBOX, "default") if m.family != "planet"]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_gearbox_is_the_planetary_rig_with_every_centre_held() -> None:
    meshes = {"sun_planet_mesh_stiffness": 1.25e7, "ring_planet_mesh_stiffness": 1.25e7}
    stiff = dict.fromkeys((f"{b}_bearing_stiffness" for b in ("carrier", "ring", "sun", "planet")), 1e13)
    held = {**meshes, **stiff, "ring_torsional_stiffness": 1e13, "planet_mass": 0.43}
    full, _ = normal_modes(planetary(3).system("with_ring", held))
    torsional = [m.frequency_hz for m in model_modes(GEARBOX, "default")]
    np.testing.assert_allclose(full[:5], torsional, rtol=1e-4, atol=1e-6)


def test_mesh_dampers_give_the_planet_modes_one_percent() -> None:
    planet = [m for m in model_modes(GEARBOX, "default") if m.family == "planet"]
    assert planet[0].damping_ratio == pytest.approx(0.01, rel=0.01)


def test_cracked_tooth_splits_the_planet_pair_and_leaves_one_of_it_alone() -> None:
    cracked = rig_with_effects(GEARBOX, [("mesh_stiffness_loss@sun-planet2", {"fraction": 0.3})])
    healthy = np.array([m.frequency_hz for m in model_modes(GEARBOX, "default")])
    after = np.array([m.frequency_hz for m in model_modes(cracked, "default")])
    assert after[3] == pytest.approx(healthy[2], rel=1e-9)
    assert np.all(after[[1, 2, 4]] < 0.99 * healthy[[1, 2, 4]])


def test_effects_that_make_sense_find_their_places_on_the_gearbox() -> None:
    assembly = GEARBOX.assembly("default")
    found = {e.id: set(e.find_places(assembly)) for e in shipped_effects().values()}
    assert {"sun-planet1", "ring-planet3"} <= found["mesh_stiffness_loss"] == found["mesh_backlash"]
    assert found["local_damper"] == {"carrier", "sun", "planet1", "planet2", "planet3"}
    assert found["shaft_torsion"] == {"carrier", "sun"}
    assert not found["planet_mass_mistune"]
    assert not found["bearing_anisotropy"]
    for effect_id in ("local_damper", "spring", "mass", "damper"):
        effect = shipped_effects()[effect_id]
        start = {p.name: p.start for p in effect.parameters}
        for place in found[effect_id]:
            before = complex_modes(assembly.system()).poles
            after = complex_modes(effect.apply(assembly, place, start).system()).poles
            assert np.max(np.abs(before - after)) > 0.1


def test_drawn_gearbox_turns_in_a_fixed_ring_and_its_carrier_takes_the_planets_along() -> None:
    drawing = drawing_of(GEARBOX.assembly("default").dofs, complete=True)
    assert drawing is not None
    assert drawing.directions == 1
    assert [b.name for b in drawing.bodies] == ["carrier", "ring", "sun", "planet1", "planet2", "planet3"]
    moved = drawing.motions({"carrier.u": 0.5, "sun.u": 1.0, "planet1.u": -1.0, "planet2.u": 0.2})
    assert (moved["planet1"].x, moved["planet1"].y, moved["planet1"].u) == (0.0, 0.5, -1.0)
    # Planet 2 of 3 sits at 120°: a carrier that turns takes it along -x and -y.
    assert moved["planet2"].x == pytest.approx(-0.5 * np.sin(2 * np.pi / 3))
    assert moved["planet2"].y == pytest.approx(0.5 * np.cos(2 * np.pi / 3))
    assert moved["ring"] == Motion(0.0, 0.0, 0.0)
    assert missing_words(moved) == "not measured: u of planet3"


def test_a_single_planets_mesh_can_be_named_in_a_rig_file(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(
        'base = "gearbox"\n[geometry]\nplanets = 4\n[parameters]\n'
        "sun_planet4_mesh_stiffness = { value = 9e6, tolerance = 0.05 }\n"
    )
    rig = load_rig(path)
    assert rig.assembly("default").named("sun-planet4 mesh").stiffness == 9e6  # type: ignore[union-attr]
    with pytest.raises(EmaError, match="at least 2 planets"):
        gearbox(1)


def test_backlash_lowers_the_resonance_as_the_force_grows() -> None:
    loose = rig_with_effects(
        GEARBOX, [(f"mesh_backlash@sun-planet{n}", {"preload": 2e-6, "gap": 1e-4}) for n in (1, 2, 3)]
    ).assembly("default")
    row = sensor_rows(loose.system(), (Dof("sun", "u"),))
    f = np.arange(930.0, 820.0, -5.0)
    peaks = []
    for level in (5.0, 60.0):
        response = harmonic_response(loose, f, level, row, row[0], harmonics=5, samples=64)
        gain = np.abs(response.displacement[0, 1]) / level
        peaks.append(f[np.argmax(np.where(response.converged, gain, 0.0))])
    assert peaks[0] == pytest.approx(913.3, abs=5.0)
    assert peaks[1] < peaks[0] - 8.0


def test_isolator_is_one_mass_on_its_spring_and_takes_its_effects() -> None:
    rig = load_rig("isolator")
    (mode,) = model_modes(rig, "default")
    assert mode.frequency_hz == pytest.approx(np.sqrt(9.702e4 / 2.0) / (2 * np.pi))
    assembly = rig.assembly("default")
    for effect_id in (
        "quadratic_stiffness",
        "cubic_stiffness",
        "viscous_damping",
        "hysteresis",
        "relaxation",
    ):
        effect = shipped_effects()[effect_id]
        assert effect.find_places(assembly) == ("isolator",)
        assert not effect.find_places(GEARBOX.assembly("default"))
    hysteresis = rig_with_effects(rig, [("hysteresis@isolator", {"force": 133.25, "rho": 631.42})])
    (soft,) = model_modes(hysteresis, "default")
    assert soft.frequency_hz == pytest.approx(np.sqrt((9.702e4 + 133.25 * 631.42) / 2.0) / (2 * np.pi))


@pytest.mark.slow
def test_a_crack_of_a_gearbox_and_a_damper_beside_it_are_found_from_raw_hits(
    tmp_path: Path,
) -> None:
    crack, damper = "mesh_stiffness_loss@ring-planet3", "local_damper@carrier"
    truth = [f"{crack}:fraction=0.25", f"{damper}:coefficient=2000"]
    simulate_campaign(tmp_path / "raw", GEARBOX, effects=truth, scatter=1.0, seed=5, format="hdf5")
    observed = ModeObservations(GEARBOX, [prepare(measure(tmp_path / "raw"))])
    settings = DiagnoseSettings(processes=1)
    found = diagnose(observed, GEARBOX, shipped_effects(), None, settings)
    base, both = found.ladder.rungs[0], found.ladder.rungs[-1]
    assert {*both.effects} == {crack, "damper@carrier"}  # in the order of their evidence
    assert both.error < 1.3 < base.error
    assert both.heldout_error < base.heldout_error
    size = both.parameters[f"{crack}.fraction"]
    assert abs(size.value - 0.25) < 3 * size.std
    # One mode alone is damped, and damping scatters from mode to mode: imaginary parts of all shapes tell of it.
    assert found.verdict == "effect"
    assert {c.label for c in found.candidates if c.claimed} == {crack, "damper@carrier"}
    size = both.parameters["damper@carrier.coefficient"]
    assert abs(size.value - 2000.0) < 3 * size.std
    assert size.std < 200.0


def test_every_mode_has_damping_also_one_that_strains_no_mesh() -> None:
    held = rig_with_effects(GEARBOX, [("shaft_torsion@carrier", {"stiffness": 4e5})])
    (low,) = (m for m in model_modes(held, "default") if m.frequency_hz < 100)
    assert low.damping_ratio == pytest.approx(0.003, rel=0.05)
