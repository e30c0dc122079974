"""Imperfect rigs and tests: each imperfection has the size that its setting says, and zero changes nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Spring
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.modes import complex_modes, eigen_solution, normal_modes
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.rigs import Rig, load_rig, model_modes
from ema_pipeline.rigs.frame import frame
from ema_pipeline.rigs.planetary import planetary
from ema_pipeline.simulate import simulate_campaign
from ema_pipeline.simulate.damping import damped_rig, draw_damping, with_modal_factors
from ema_pipeline.simulate.hammer import ForceHistory, Pulse
from ema_pipeline.simulate.hits import HitDraw, HitSeries, as_struck
from ema_pipeline.simulate.imperfections import LEVELS, Imperfections
from ema_pipeline.simulate.parts import draw_parts, parts_of, scattered_rig
from ema_pipeline.simulate.poles import pole_accelerance
from ema_pipeline.simulate.response import integrated_response
from ema_pipeline.simulate.sensing import ChannelDraw, across, with_sensors
from ema_pipeline.simulate.settings import SimulationSettings

RIG = load_rig("planetary")
CLEAN: dict[str, Any] = {"force_noise_n": 0.0, "acceleration_noise": 0.0, "offset_v": 0.0, "format": "hdf5"}
ZERO = {
    "part_scatter": 0,
    "calibration": 0,
    "transverse": 0,
    "aim_deg": 0,
    "drift": 0,
    "damping_scatter": 0,
}


def records(folder: Path) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Volts by record file and channel."""
    found = {}
    for path in sorted(folder.rglob("*.h5")):
        with h5py.File(path) as file:
            found[str(path.relative_to(folder))] = {name: file[name][()] for name in file}
    return found


def simulated(
    folder: Path, rig: Rig | str | Path, **settings: Any
) -> tuple[dict[str, dict[str, NDArray[np.float64]]], dict[str, Any]]:
    """Records and truth of a campaign."""
    simulate_campaign(folder, rig, **settings)
    return records(folder), json.loads((folder / "truth.json").read_text(encoding="utf-8"))


def assert_equal(
    a: dict[str, dict[str, NDArray[np.float64]]], b: dict[str, dict[str, NDArray[np.float64]]]
) -> None:
    assert a.keys() == b.keys()
    for file, channels in a.items():
        for name, volts in channels.items():
            np.testing.assert_array_equal(volts, b[file][name], err_msg=f"{file} {name}")


def test_zero_imperfection_is_what_it_was_to_the_last_bit(tmp_path: Path) -> None:
    common: dict[str, Any] = {"format": "hdf5", "duration_s": 0.2, "seed": 4, "scatter": 1.0}
    plain, truth = simulated(tmp_path / "plain", "planetary", **common)
    zero, _ = simulated(tmp_path / "zero", "planetary", imperfection="normal", **ZERO, **common)
    assert_equal(plain, zero)
    assert "imperfections" not in truth


def test_levels_are_the_stated_ones_and_single_values_win() -> None:
    normal = SimulationSettings(imperfection="normal").imperfections
    assert normal == LEVELS["normal"] == Imperfections(0.03, 0.04, 0.05, 8.0, 0.001, 0.5)
    assert SimulationSettings(imperfection="good", drift=0.0).imperfections == replace(
        LEVELS["good"], drift=0.0
    )
    assert SimulationSettings().imperfections.none


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"imperfection": "bad"}, "imperfection = 'bad'.*'good' or 'normal'"),
        ({"part_scatter": -0.1}, "part_scatter = -0.1"),
        ({"transverse": 5}, "transverse = 5: .*less than 1"),
        ({"drift_kind": "random"}, "drift_kind = 'random'"),
        ({"damping_scater": 0.1}, "did you mean 'damping_scatter'"),
    ],
)
def test_settings_out_of_range_are_named(tmp_path: Path, setting: dict[str, Any], message: str) -> None:
    with pytest.raises(EmaError, match=message):
        simulate_campaign(tmp_path / "raw", "frame", **setting)


def test_every_spring_and_every_body_is_a_part_of_its_own() -> None:
    parts = parts_of(RIG.assembly("with_ring"))
    assert parts["carrier mass"] == ("carrier mass x", "carrier mass y")
    assert parts["planet2 mass"] == ("planet2 mass zeta", "planet2 mass eta")
    assert ("carrier mass u",) in parts.values()
    assert parts["sun bearing x"] == ("sun bearing x",)
    assert parts["planet1 bearing radial"] == ("planet1 bearing radial",)
    assert "sun bearing u" not in parts  # free to turn


def test_parts_scatter_by_the_stated_size_and_are_the_same_in_all_configurations() -> None:
    drawn = [draw_parts(RIG, 0.03, seed) for seed in range(150)]
    assembly = RIG.assembly("with_ring")
    heavy = {p for p, names in parts_of(assembly).items() if isinstance(assembly.named(names[0]), Mass)}
    springs = [np.log(d[p]) for d in drawn for p in d if p not in heavy]
    masses = [np.log(d[p]) for d in drawn for p in d if p in heavy]
    assert np.std(springs) == pytest.approx(0.03, rel=0.05)
    assert np.std(masses) == pytest.approx(0.0075, rel=0.05)
    rig = scattered_rig(RIG, drawn[0])
    for name, nominal in (
        ("planet1 bearing radial", 3.82e4),
        ("carrier mass x", 1.0),
        ("carrier mass y", 1.0),
    ):
        values = [rig.assembly(c).named(name) for c in rig.configurations]
        assert values[0] == values[1]
        assert isinstance(values[0], Spring | Mass)
        value = values[0].stiffness if isinstance(values[0], Spring) else values[0].value
        assert value == pytest.approx(nominal * drawn[0][name.removesuffix(" x").removesuffix(" y")])


def test_a_mesh_loses_the_stated_share_of_its_own_stiffness_and_an_added_mass_its_own_weight() -> None:
    factors = draw_parts(RIG, 0.1, 1)
    effects = [
        ("mesh_stiffness_loss@sun-planet1", {"fraction": 0.3}),
        ("planet_mass_mistune@planet2", {"mass": 0.1}),
    ]
    rig = rig_with_effects(scattered_rig(RIG, factors), effects)
    values = {p.name: p.value for p in rig.parameters.values()}
    assembly = rig.assembly("no_ring", values)
    mesh = assembly.named("sun-planet1 mesh")
    assert isinstance(mesh, Spring)
    assert mesh.stiffness == pytest.approx(0.7e7 * factors["sun-planet1 mesh"])
    mass = assembly.system().mass
    at = assembly.dofs.index("planet2.zeta")
    assert mass[at, at] == pytest.approx(0.43 * factors["planet2 mass"] + 0.1)


def test_a_calibration_of_4_percent_shows_in_the_frfs(tmp_path: Path) -> None:
    common = {**CLEAN, "duration_s": 0.3, "hits": 1, "seed": 7}
    ideal, _ = simulated(tmp_path / "ideal", "frame", **common)
    real, truth = simulated(tmp_path / "real", "frame", calibration=0.04, **common)
    gains = {name: c["gain"] for name, c in truth["imperfections"]["channels"].items()}
    for file, channels in real.items():
        for name, volts in channels.items():
            gain = gains[name.replace("_", ".")]
            np.testing.assert_allclose(volts, gain * ideal[file][name], atol=3e-6, err_msg=name)
    draws = [
        c["gain"]
        for seed in range(30)
        for c in simulated(tmp_path / f"s{seed}", "frame", calibration=0.04, **{**common, "seed": seed})[1][
            "imperfections"
        ]["channels"].values()
    ]
    assert np.std(np.log(draws)) == pytest.approx(0.04, rel=0.2)


def test_a_sensor_has_the_same_gain_in_all_configurations(tmp_path: Path) -> None:
    common = {**CLEAN, "duration_s": 0.3, "hits": 1, "impacts": ["sun.y"], "sensors": ["sun.y", "ring.x"]}
    ideal, _ = simulated(tmp_path / "ideal", "planetary", **common)
    real, _ = simulated(tmp_path / "real", "planetary", calibration=0.1, **common)
    ratios = [
        np.max(real[file]["sun_y"]) / np.max(ideal[file]["sun_y"]) for file in ideal if "sun_y" in ideal[file]
    ]
    assert len(ratios) == 2
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-4)
    assert abs(ratios[0] - 1) > 1e-3


def test_an_accelerometer_reads_a_share_of_the_motion_across_its_axis(tmp_path: Path) -> None:
    common = {**CLEAN, "duration_s": 0.3, "hits": 1, "configurations": ["no_ring"], "impacts": ["sun.y"]}
    ideal, _ = simulated(tmp_path / "ideal", RIG, **common)
    real, truth = simulated(tmp_path / "real", RIG, transverse=0.05, **common)
    channels = truth["imperfections"]["channels"]
    a, b = next(iter(ideal.values())), next(iter(real.values()))
    np.testing.assert_allclose(b["hammer"], a["hammer"], atol=3e-6)
    for own, beside, sign in (
        ("sun_x", "sun_y", 1),
        ("carrier_y", "carrier_x", -1),
        ("planet2_x", "planet2_y", 1),
    ):
        share = channels[own.replace("_", ".")]["transverse"]
        assert 0 < abs(share) < 0.2
        np.testing.assert_allclose(b[own], a[own] + sign * share * a[beside], atol=5e-6, err_msg=own)
    angle, share = channels["sun.u"]["angle_rad"], channels["sun.u"]["transverse"]
    radial = np.cos(angle) * a["sun_x"] + np.sin(angle) * a["sun_y"]
    np.testing.assert_allclose(b["sun_u"], a["sun_u"] + share * radial, atol=5e-6)


def test_across_a_body_that_moves_one_way_only_there_is_nothing() -> None:
    assert across(frame(2).assembly("default"), Dof("storey1", "x"), 0.0) == {}
    assert across(load_rig("gearbox").assembly("default"), Dof("sun", "u"), 1.0) == {}
    assembly = RIG.assembly("no_ring")
    assert across(assembly, Dof("planet1", "zeta"), 0.0) == {"planet1.eta": 1.0}
    _, places = with_sensors(assembly, [Dof("sun", "x", -1)], {"sun.x": ChannelDraw()})
    assert places[0].sign == -1


def test_a_hit_that_is_off_pushes_both_ways() -> None:
    assembly = RIG.assembly("no_ring")
    struck, place = as_struck(assembly, Dof("sun", "y", -1), HitDraw(aim_deg=30.0), 0.0)
    system = struck.system()
    row = sensor_rows(system, (place,))[0]
    assert row[system.dofs.index("sun.y")] == pytest.approx(-np.cos(np.pi / 6))
    assert row[system.dofs.index("sun.x")] == pytest.approx(0.5)
    assert np.linalg.norm(row) == pytest.approx(1.0)


def test_hits_scatter_in_direction_and_each_is_written_down(tmp_path: Path) -> None:
    simulate_campaign(tmp_path, RIG, aim_deg=8.0, hits=12, duration_s=0.15, configurations=["no_ring"])
    truth = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    aims = [a for r in truth["configurations"]["no_ring"]["records"] for a in r["aim_deg"]]
    assert len(aims) == 48
    assert np.std(aims) == pytest.approx(8.0, rel=0.3)


def peak_hz(record: dict[str, NDArray[np.float64]]) -> float:
    """Frequency of the largest peak of the only sensor, between lines by a parabola."""
    volts = np.pad(next(v for k, v in record.items() if k != "hammer"), (0, 2**18))
    level = np.log(np.abs(np.fft.rfft(volts)))
    k = int(np.argmax(level))
    left, top, right = level[k - 1 : k + 2]
    return float((k + 0.5 * (left - right) / (left - 2 * top + right)) * 5120.0 / len(volts))


def test_drift_shows_as_shifted_peaks(tmp_path: Path) -> None:
    data, truth = simulated(tmp_path, frame(1), drift=0.02, hits=6, duration_s=6.0, seed=3, **CLEAN)
    hits = {r["file"]: r["frequency_factor"][0] for r in truth["configurations"]["default"]["records"]}
    peaks = np.array([peak_hz(data[file]) for file in hits])
    factors = np.array(list(hits.values()))
    assert np.ptp(factors) > 0.02
    np.testing.assert_allclose(peaks / peaks[0], factors / factors[0], rtol=2e-4)


def test_drift_goes_on_from_hit_to_hit_where_it_is_a_walk() -> None:
    ends = []
    for seed in range(300):
        series = HitSeries(Imperfections(drift=1e-3), "walk", np.random.default_rng(seed))
        ends.append([series.draw().frequency_factor - 1 for _ in range(16)])
    assert np.std([e[0] for e in ends]) == pytest.approx(1e-3, rel=0.15)
    assert np.std([e[15] for e in ends]) == pytest.approx(4e-3, rel=0.15)


def test_damping_scatter_shows_in_the_decay(tmp_path: Path) -> None:
    data, truth = simulated(
        tmp_path,
        frame(1),
        damping_scatter=0.5,
        hits=1,
        duration_s=3.0,
        seed=5,
        accelerometer_sensitivity_mv=100.0,
        **CLEAN,
    )
    factor = truth["imperfections"]["damping_factors"]["default"][0]
    assert abs(np.log(factor)) > 0.1
    volts = next(iter(data.values()))["storey1_x"][1024:]
    peaks = np.flatnonzero((volts[1:-1] > volts[:-2]) & (volts[1:-1] >= volts[2:])) + 1
    peaks = peaks[volts[peaks] > 0.03 * volts.max()]
    slope = np.polyfit(peaks / 5120.0, np.log(volts[peaks]), 1)[0]
    omega = np.sqrt(2e5 / 5.0)
    assert -slope / omega == pytest.approx(0.01 * factor, rel=0.01)
    assert truth["configurations"]["default"]["modes"][0]["damping_ratio"] == pytest.approx(0.01 * factor)


@pytest.mark.parametrize("name", ["planetary", "gearbox", "frame"])
def test_damping_factors_are_those_of_the_modes_of_any_rig(name: str) -> None:
    base = load_rig(name)
    configuration = base.configurations[-1]
    factors = draw_damping(base, 0.3, 2)
    rig = damped_rig(base, base, factors)
    before, after = model_modes(base, configuration), model_modes(rig, configuration)
    wanted = [
        (m.frequency_hz, f * m.damping_ratio) for f, m in zip(factors[configuration], before, strict=True)
    ]
    found = [(m.frequency_hz, m.damping_ratio) for m in after]
    # repeated modes come in any order
    in_order = [sorted((round(f, 1), ratio) for f, ratio in modes) for modes in (found, wanted)]
    np.testing.assert_allclose(*in_order, rtol=2e-3)


def test_less_damping_by_one_damper_takes_energy_from_every_motion() -> None:
    """It couples the modes: with the diagonal of its matrix alone reduced, some motions would gain energy."""
    chain = Assembly(
        ("a.x", "b.x"),
        (
            Mass("a", {"a.x": 1.0}, 2.0),
            Mass("b", {"b.x": 1.0}, 1.0),
            Spring("left", {"a.x": 1.0}, 3e5),
            Spring("middle", {"a.x": 1.0, "b.x": -1.0}, 2e5),
            Damper("foot", {"a.x": 1.0}, 5.0),
        ),
    )
    factors = np.array([0.5, 0.3])
    system = with_modal_factors(chain, {"foot"}, factors).system()
    values = np.linalg.eigvalsh(system.damping)
    assert values[0] > -1e-9 * values[-1]
    shapes = eigen_solution(chain.system())[1]
    before, after = (np.diag(shapes.T @ s.damping @ shapes) for s in (chain.system(), system))
    np.testing.assert_allclose(after, factors * before)


def test_what_an_effect_adds_to_damping_keeps_its_size() -> None:
    effects = [("local_damper@sun", {"coefficient": 1e-2})]
    rig = rig_with_effects(RIG, effects)
    values = {p.name: p.value for p in rig.parameters.values()}
    factors = {c: tuple(0.0 for _ in RIG.assembly(c).dofs) for c in RIG.configurations}
    system = damped_rig(rig, RIG, factors).system("no_ring", values)
    np.testing.assert_allclose(system.damping, rig.system("no_ring", values).damping, atol=1e-15, rtol=1e-12)
    assert system.modal_damping_ratio == 0.0


@pytest.mark.parametrize(
    ("rig", "effects"),
    [
        ("planetary", ["local_damper@sun", "gyroscopic@carrier"]),
        ("planetary", ["hysteretic_damping@sun-planet"]),
        ("gearbox", []),
        ("frame", []),
    ],
)
def test_sum_over_poles_is_the_accelerance(rig: str, effects: list[str]) -> None:
    base = rig_with_effects(load_rig(rig), effects)
    configuration = base.configurations[0]
    system = base.system(configuration)
    rows = np.eye(len(system.dofs))
    f = np.concatenate([[0.0], np.linspace(1.3, 2500, 400)])
    exact = accelerance(system, f, rows, rows[:3])
    found = pole_accelerance(system, f, rows, rows[:3])
    np.testing.assert_allclose(found[..., 1:], exact[..., 1:], atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(found[..., 0], exact[..., 0], atol=1e-4 * np.abs(exact).max())


OWN = """name = "two"
[[masses]]
at = "a.x"
value = 1.0
[[masses]]
at = "a.y"
value = 1.0
[[masses]]
at = "b.x"
value = 2.0
[[springs]]
at = "a.x"
value = 1e5
[[springs]]
at = "a.y"
value = 2e5
[[springs]]
between = ["a.x", "b.x"]
value = 1e5
"""


@pytest.mark.parametrize(
    ("rig", "effect"),
    [
        ("planetary", None),
        ("planetary", "bearing_cubic@sun:stiffness=1e12"),
        ("gearbox", None),
        ("gearbox", "mesh_backlash@sun-planet1:preload=2e-6"),
        ("frame", "damper@storey1.x:coefficient=20"),
        ("file", None),
        ("file", "mass@b.x:mass=0.1"),
        (5, None),
    ],
)
def test_every_rig_can_be_imperfect(tmp_path: Path, rig: str | int, effect: str | None) -> None:
    if rig == "file":
        (tmp_path / "own.toml").write_text(OWN, encoding="utf-8")
        rig = str(tmp_path / "own.toml")
    made: Rig | str = planetary(rig) if isinstance(rig, int) else rig
    options = {"effects": [effect] if effect else [], "duration_s": 0.2, "format": "hdf5"}
    data, truth = simulated(
        tmp_path / "raw", made, imperfection="normal", hits=2, hits_per_record=2, **options
    )
    assert all(np.all(np.isfinite(v)) for channels in data.values() for v in channels.values())
    drawn = truth["imperfections"]
    assert all(0.8 < f < 1.25 for f in drawn["parts"].values())
    assert drawn["channels"]["hammer"]["gain"] != 1.0
    first = next(iter(truth["configurations"].values()))["records"][0]
    assert len(first["aim_deg"]) == len(first["frequency_factor"]) == 2
    if rig == str(tmp_path / "own.toml"):
        assert {"a mass", "b mass", "a-b spring x"} <= set(drawn["parts"])


def test_each_imperfection_leaves_the_others_and_the_noise_as_they_are(tmp_path: Path) -> None:
    common: dict[str, Any] = {"imperfection": "normal", "duration_s": 0.15, "hits": 1, "format": "hdf5"}
    _, full = simulated(tmp_path / "full", "frame", **common)
    _, less = simulated(tmp_path / "less", "frame", aim_deg=0.0, part_scatter=0.0, **common)
    assert less["imperfections"]["channels"] == full["imperfections"]["channels"]
    assert less["imperfections"]["damping_factors"] == full["imperfections"]["damping_factors"]
    drift = [[r["frequency_factor"] for r in t["configurations"]["default"]["records"]] for t in (full, less)]
    assert drift[0] == drift[1]


def test_a_drifted_rig_has_all_its_frequencies_changed_alike_and_keeps_its_damping() -> None:
    assembly = RIG.assembly("with_ring")
    drifted, _ = as_struck(assembly, Dof("sun", "y"), HitDraw(frequency_factor=1.01), 0.0)
    f0, f1 = (normal_modes(a.system())[0] for a in (assembly, drifted))
    np.testing.assert_allclose(f1, 1.01 * f0, atol=1e-6)
    zeta = complex_modes(drifted.system()).damping_ratio
    np.testing.assert_allclose(zeta[zeta > 0], 0.01, rtol=1e-6)


def test_hits_of_one_record_of_a_nonlinear_rig_are_alike(tmp_path: Path) -> None:
    from ema_pipeline.simulate.folder import TestFolder

    assembly = rig_with_effects(RIG, ["bearing_cubic@sun"]).assembly("no_ring")
    hits = ((Pulse(0.1, 1.0, 1e-3),), (Pulse(0.3, 1.0, 1e-3),))
    draws = (HitDraw(1.0, 1.01), HitDraw(2.0, 0.99))
    together = TestFolder._together(assembly, hits, draws)
    assert together == [((hits[0][0], hits[1][0]), draws[0])]
    linear = TestFolder._together(RIG.assembly("no_ring"), hits, draws)
    assert [h for _, h in linear] == list(draws)
    series = HitSeries(LEVELS["normal"], "independent", np.random.default_rng(0))
    one, other = TestFolder._draws(assembly, series, 2)
    assert one == other
    history = ForceHistory(together[0][0], 5120.0, 2560)
    struck, place = as_struck(assembly, Dof("sun", "y"), draws[0], 0.0)
    ((force, _),) = integrated_response(struck, (history,), place, (Dof("sun", "x"),))
    assert np.max(force) > 0.5
