"""Simulated tests: exact where they are noise-free, and readable by anyone's libraries."""

from __future__ import annotations

import json
import re
import tomllib
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.io.wavfile
import scipy.signal
from scipy.integrate import trapezoid

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.frf import accelerance
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.mechanics.time_response import time_response
from ema_pipeline.rigs import load_rig, model_modes
from ema_pipeline.rigs.frame import frame
from ema_pipeline.simulate import simulate_campaign
from ema_pipeline.simulate.campaign import default_impacts, default_sensors, true_values
from ema_pipeline.simulate.hammer import ForceHistory, Pulse
from ema_pipeline.simulate.recorder import quantise
from ema_pipeline.simulate.response import integrated_response, linear_response

RIG = load_rig("planetary")


def read_h5(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


def test_pulse_spectrum_is_the_transform_of_the_pulse() -> None:
    pulse = Pulse(time_s=0.003, peak_n=120.0, contact_s=6e-4)
    t = np.linspace(0, 0.006, 600_001)
    f = np.array([0.0, 500.0, 1 / 6e-4, 2100.0, 2 / 6e-4])
    numeric = [trapezoid(pulse.force(t) * np.exp(-2j * np.pi * x * t), t) for x in f]
    np.testing.assert_allclose(pulse.spectrum(f), numeric, atol=1e-7 * 120 * 6e-4)


@pytest.mark.parametrize("effect", [None, "local_damper@sun", "hysteretic_damping@sun-planet"])
def test_frf_of_noise_free_data_equals_the_models_to_a_thousandth(effect: str | None) -> None:
    from ema_pipeline.effects.rig import rig_with_effects

    rig = rig_with_effects(RIG, [effect] if effect else [])
    rate = 5120.0
    n = round(12 * rate)  # long enough for every mode to die out within the record
    history = ForceHistory((Pulse(0.1, 150.0, 6e-4),), rate, n)
    impact, sensors = Dof("sun", "y"), default_sensors(RIG.assembly("with_ring"))
    assembly = rig.assembly("with_ring", {"modal_damping_ratio": 0.02})
    ((force, response),) = linear_response(assembly, (history,), impact, sensors)
    f = np.fft.rfftfreq(n, 1 / rate)
    measured = np.fft.rfft(response) / np.fft.rfft(force)
    system = assembly.system()
    exact = accelerance(system, f, sensor_rows(system, sensors), sensor_rows(system, (impact,)))[:, 0]
    band = (f > 2) & (f < rate / 2.56)
    error = np.abs(measured - exact)[:, band]
    # Symmetry makes some FRFs zero, so all are held against the largest.
    assert np.max(error) < 1e-5 * np.abs(exact[:, band]).max()
    strong = np.abs(exact[:, band]) > 1e-5 * np.abs(exact[:, band]).max()
    assert np.max(error[strong] / np.abs(exact[:, band])[strong]) < 1e-3


def test_response_equals_fine_time_stepping_behind_an_anti_alias_filter() -> None:
    # An independent route: 64-fold oversampled ramp-invariant recursion, then decimation of both channels.
    rate, over, n = 2048.0, 32, 2048
    rig = frame(2)
    assembly = rig.assembly("default", {"modal_damping_ratio": 0.03})
    pulse = Pulse(0.1, 100.0, 16e-3)  # no energy near the filter's flank
    impact, sensors = Dof("storey1", "x"), (Dof("storey2", "x"), Dof("storey1", "x"))
    ((force, response),) = linear_response(assembly, (ForceHistory((pulse,), rate, n),), impact, sensors)
    t = np.arange(n * over) / (rate * over)
    system = assembly.system()
    fine = time_response(
        system,
        rate * over,
        pulse.force(t)[None],
        sensor_rows(system, sensors),
        sensor_rows(system, (impact,)),
    )
    np.testing.assert_allclose(force, pulse.force(t[::over]), atol=5e-4 * 100)
    scale = np.abs(fine.acceleration).max()
    np.testing.assert_allclose(response, fine.acceleration[:, ::over], atol=1e-3 * scale)


def test_undamped_mode_is_refused_because_it_would_ring_for_ever() -> None:
    history = ForceHistory((Pulse(0.1, 1.0, 6e-4),), 5120.0, 512)
    assembly = RIG.assembly("no_ring", {"modal_damping_ratio": 0.0})
    with pytest.raises(EmaError, match="some damping"):
        linear_response(assembly, (history,), Dof("sun", "x"), (Dof("sun", "x"),))


def test_converter_rounds_to_its_steps_and_clips_at_its_range() -> None:
    volts = np.array([-12.0, -0.4, 0.0, 0.26, 12.0])
    np.testing.assert_allclose(quantise(volts, 4, 8.0), [-8.0, 0.0, 0.0, 0.0, 7.0])
    fine = quantise(volts[1:4], 24, 8.0)
    np.testing.assert_allclose(fine, volts[1:4], atol=8.0 / 2**23)


def test_campaign_is_written_to_the_layout_with_its_truth_beside(tmp_path: Path) -> None:
    out = tmp_path / "raw"
    made = simulate_campaign(
        out,
        "planetary",
        effects=["mesh_stiffness_loss@sun-planet1:fraction=0.35"],
        format="hdf5",
        duration_s=0.25,
        seed=3,
        scatter=1.0,
    )
    assert made.configurations == ("no_ring", "with_ring")
    total = 0
    for configuration in made.configurations:
        test = tomllib.loads((out / configuration / "test.toml").read_text(encoding="utf-8"))
        assert test["schema"] == 1
        assert test["rig"] == "planetary"
        assert test["configuration"] == configuration
        names = {c["name"] for c in test["channels"]}
        for record in test["records"]:
            data = read_h5(out / configuration / record["file"])
            assert set(data) == names
            assert all(len(v) == round(0.25 * 5120) for v in data.values())
            assert RIG.knows(configuration, Dof.parse(record["impact"]))
        total += len(test["records"])
    assert total == made.records
    truth = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    assert truth["values"]["mesh_stiffness_loss@sun-planet1.fraction"] == 0.35
    assert truth["effects"] == ["mesh_stiffness_loss@sun-planet1:fraction=0.35"]
    assert len(truth["configurations"]["with_ring"]["modes"]) == 15
    carrier = truth["values"]["carrier_mass"]
    assert carrier != 1.0
    assert abs(carrier - 1.0) < 0.05


def test_same_seed_gives_the_same_samples_and_another_seed_others(tmp_path: Path) -> None:
    files = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        options = {"format": "hdf5", "duration_s": 0.2, "hits": 1, "seed": seed}
        simulate_campaign(tmp_path / name, "frame", **options)
        files.append(read_h5(next((tmp_path / name).glob("storey1*.h5"))))
    np.testing.assert_array_equal(files[0]["hammer"], files[1]["hammer"])
    assert np.any(files[0]["hammer"] != files[2]["hammer"])


def test_scatter_stays_off_unless_asked_for_and_keeps_free_parameters() -> None:
    random = np.random.default_rng(0)
    assert true_values(RIG, {}, 0.0, random)["sun_mass"] == 2.0
    drawn = [true_values(RIG, {"ring_mass": 4.0}, 1.0, random) for _ in range(200)]
    assert np.std([d["sun_mass"] for d in drawn]) == pytest.approx(0.02, rel=0.2)
    assert {d["ring_mass"] for d in drawn} == {4.0}
    assert {d["sun_planet_mesh_stiffness"] for d in drawn} == {1e7}


def test_noise_and_offset_have_the_stated_sizes(tmp_path: Path) -> None:
    simulate_campaign(
        tmp_path / "raw",
        "frame",
        format="hdf5",
        hits=1,
        force_noise_n=0.5,
        acceleration_noise=0.1,
        offset_v=0.02,
    )
    data = read_h5(next((tmp_path / "raw").glob("storey1*.h5")))
    quiet = data["hammer"][600:]
    assert np.std(quiet) == pytest.approx(0.5 * 2.25e-3, rel=0.05)
    before = slice(0, 480)
    assert np.std(data["storey3_x"][before]) == pytest.approx(0.1e-3, rel=0.15)
    offsets = [abs(np.mean(v[before])) for v in data.values()]
    assert 0.002 < max(offsets) < 0.1


def test_double_hit_bounces_in_the_named_hit_only(tmp_path: Path) -> None:
    simulate_campaign(
        tmp_path / "raw", "frame", format="hdf5", hits=3, double_hits="storey2.x#2", duration_s=0.3
    )

    def second_peak(file: str) -> float:
        force = read_h5(tmp_path / "raw" / file)["hammer"]
        force = np.abs(force - np.median(force))
        peak = int(np.argmax(force))
        return float(force[peak + 20 :].max() / force[peak])

    assert second_peak("storey2_x_150N_2.h5") > 0.2
    for clean in ("storey2_x_150N_1.h5", "storey2_x_150N_3.h5", "storey1_x_150N_2.h5"):
        assert second_peak(clean) < 0.01


def test_overload_clips_the_hammer_of_the_named_hit(tmp_path: Path) -> None:
    simulate_campaign(
        tmp_path / "raw",
        "frame",
        format="hdf5",
        overloads=["storey2.x#1"],
        duration_s=0.3,
        sample_rate_hz=20480.0,
        offset_v=0.0,
    )

    def flat(number: int) -> int:
        force = read_h5(tmp_path / "raw" / f"storey2_x_150N_{number}.h5")["hammer"]
        return int(np.sum(force > 0.995 * force.max()))

    assert flat(1) >= 4
    assert flat(2) <= 2


def test_levels_and_continuous_records_hold_the_blows_they_should(tmp_path: Path) -> None:
    simulate_campaign(
        tmp_path / "raw",
        "frame",
        format="hdf5",
        hits=3,
        hits_per_record=3,
        peak_force_n="30, 300",
        duration_s=1.0,
        force_spread=0.0,
    )
    files = sorted(p.name for p in (tmp_path / "raw").glob("storey1*.h5"))
    assert files == ["storey1_x_300N_1.h5", "storey1_x_30N_1.h5"]
    for file, level in zip(files, (300.0, 30.0), strict=True):
        force = read_h5(tmp_path / "raw" / file)["hammer"] / 2.25e-3
        force = force - np.median(force)
        peaks, _ = scipy.signal.find_peaks(force, height=0.5 * level, distance=1000)
        assert len(peaks) == 3
        np.testing.assert_allclose(force[peaks], level, rtol=0.3)  # sampling misses the peak


def test_every_format_holds_the_same_volts(tmp_path: Path) -> None:
    import nptdms
    import pandas as pd
    import pyuff

    stem = "storey2_x_150N_1"
    for name in ("hdf5", "csv", "mat", "wav", "tdms", "uff"):
        simulate_campaign(tmp_path / name, "frame", format=name, duration_s=0.2, hits=1, seed=5)
    truth = read_h5(tmp_path / "hdf5" / f"{stem}.h5")
    table = pd.read_csv(tmp_path / "csv" / f"{stem}.csv")
    mat = scipy.io.loadmat(tmp_path / "mat" / f"{stem}.mat")
    rate, wav = scipy.io.wavfile.read(tmp_path / "wav" / f"{stem}.wav")
    tdms = nptdms.TdmsFile.read(tmp_path / "tdms" / f"{stem}.tdms")["test"]
    sets = {s["id1"]: s["data"] for s in pyuff.UFF(str(tmp_path / "uff" / f"{stem}.uff")).read_sets()}
    assert rate == 5120
    description = tomllib.loads((tmp_path / "wav" / "test.toml").read_text(encoding="utf-8"))
    assert [c["name"] for c in description["channels"]] == ["ch1", "ch2", "ch3", "ch4"]
    for i, (name, volts) in enumerate(truth.items()):
        for other in (table[name], mat[name].ravel(), tdms[name][:], sets[name]):
            np.testing.assert_allclose(other, volts, rtol=1e-6, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(wav[:, i], volts, rtol=1e-6, atol=1e-9)


def test_defaults_put_sensors_on_all_bodies_and_strike_all_directions() -> None:
    sensors = default_sensors(RIG.assembly("with_ring"))
    assert len(sensors) == 15
    assert {s.direction for s in sensors} == {"x", "y", "u"}
    impacts = default_impacts(sensors)
    assert {i.direction for i in impacts} == {"x", "y", "u"}
    assert {i.body for i in impacts} == {"carrier", "ring", "sun", "planet1", "planet2"}


def test_rig_file_travels_with_the_data(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text('base = "planetary"\n[geometry]\nplanets = 3\n', encoding="utf-8")
    simulate_campaign(
        tmp_path / "raw", file, configurations=["no_ring"], duration_s=0.2, hits=1, format="hdf5"
    )
    assert (tmp_path / "raw" / "rig.toml").read_text(encoding="utf-8") == file.read_text(encoding="utf-8")
    test = tomllib.loads((tmp_path / "raw" / "test.toml").read_text(encoding="utf-8"))
    assert "rig" not in test
    assert "planet3.x" in {c.get("dof") for c in test["channels"]}
    truth = json.loads((tmp_path / "raw" / "truth.json").read_text(encoding="utf-8"))
    expected = [m.frequency_hz for m in model_modes(load_rig(file), "no_ring")]
    found = [m["frequency_hz"] for m in truth["configurations"]["no_ring"]["modes"]]
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"configurations": ["with_rign"]}, "did you mean 'with_ring'"),
        ({"effects": ["sensor_mas@all"]}, "did you mean 'sensor_mass'"),
        ({"values": {"sun_mas": 1.0}}, "did you mean 'sun_mass'"),
        ({"impacts": ["sun.z"]}, "did you mean 'sun"),
        ({"hit": 3}, "did you mean 'hits'"),
        ({"double_hits": ["sun.y"]}, "not of the form"),
        ({"double_hits": ["sun.y#9"]}, "2 hits per point"),
        ({"peak_force_n": "30,hard"}, "peak_force_n.*'hard'"),
        ({"converter_bits": 3}, "converter_bits = 3"),
        ({"values": {"sun_mass": "abc"}}, "value of parameter 'sun_mass' = abc: give a number"),
        ({"values": {"sun_mass": 1e300}}, "'sun_mass' = 1e\\+300: give a number of at most 1e\\+30"),
        (
            {"sample_rate_hz": 1e12},
            "sample_rate_hz = 1e\\+12 and duration_s = 2 make 2e\\+12 samples per hit",
        ),
        (
            {"sample_rate_hz": 1e-300},
            "contact_s = 0.0006 is too short for sample_rate_hz = 1e-300",
        ),
        ({"contact_s": 1e-300}, "contact_s = 1e-300 is too short"),
        (
            {"duration_s": 0.1},
            "duration_s = 0.1 ends before the blow does, 0.111 s after the start; raise it",
        ),
        ({"contact_s": 1e30}, "duration_s = 2 ends before the blow does"),
        ({"configurations": ["no_ring", "no_ring"]}, "configuration 'no_ring' is named twice"),
        ({"sensors": ["sun.x", "-sun.x"]}, "sensor 'sun.x' is named twice"),
        ({"impacts": ["sun.x", "sun.x"]}, "impact 'sun.x' is named twice"),
        ({"effects": ["sensor_mass@all:mass=1,mass=2"]}, "'mass' is given twice"),
        ({"peak_force_n": [150, 150.0000001]}, "above 0 N, and each another one: 150, 150"),
        ({"peak_force_n": [0.0]}, "above 0 N, and each another one: 0"),
        (
            {"impacts": ["sun.x"], "overloads": ["sun.y#1"]},
            "hit 'sun.y#1': no hit is on sun.y; they are on sun.x",
        ),
        ({"effects": ["spring@sun.x:stiffness=-1e9"]}, "stiffness is negative around 'sun.x'"),
        ({"duration_s": 1e9}, "make 5.12e\\+12 samples per hit, 1e\\+07 at most; lower one of them"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(EmaError, match=message):
        simulate_campaign(tmp_path / "raw", "planetary", **arguments)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_holds_a_test_is_not_written_over(tmp_path: Path) -> None:
    simulate_campaign(tmp_path / "raw", "frame", duration_s=0.2, hits=1)
    with pytest.raises(EmaError, match="holds a test already"):
        simulate_campaign(tmp_path / "raw", "frame", duration_s=0.2, hits=1)


@pytest.mark.parametrize("name", ["truth.json", "rig.toml", "{record}"])
def test_no_file_is_replaced_and_none_is_left_where_one_would_be(tmp_path: Path, name: str) -> None:
    rig = tmp_path / "mine.toml"
    rig.write_text('base = "frame"\n', encoding="utf-8")
    simulate_campaign(tmp_path / "first", rig, duration_s=0.2, hits=1)
    record = next(path.name for path in (tmp_path / "first").iterdir() if path.suffix == ".uff")
    raw = tmp_path / "raw"
    raw.mkdir()
    mine = raw / name.format(record=record)
    mine.write_text("mine", encoding="utf-8")
    told = f"{mine}: exists already and is kept; name another folder, or remove it"
    with pytest.raises(EmaError, match=re.escape(told)):
        simulate_campaign(raw, rig, duration_s=0.2, hits=1)
    assert [path.name for path in raw.iterdir()] == [mine.name]
    assert mine.read_text(encoding="utf-8") == "mine"


def test_a_rig_file_that_lies_in_the_folder_already_stays(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text('base = "frame"\n', encoding="utf-8")
    simulate_campaign(tmp_path, rig, duration_s=0.2, hits=1)
    assert rig.read_text(encoding="utf-8") == 'base = "frame"\n'
    assert (tmp_path / "test.toml").is_file()


SAMPLES = Path(__file__).parents[2] / "sample_data"


@pytest.mark.parametrize("name", ["healthy", "hidden_effect"])
def test_sample_data_are_what_their_documented_commands_make(tmp_path: Path, name: str) -> None:
    if not SAMPLES.is_dir():
        pytest.skip("sample_data is not at hand (an installed package does not hold it)")
    readme = (SAMPLES / "README.md").read_text(encoding="utf-8")
    words = next(
        line for line in readme.splitlines() if line.startswith(f"ema simulate sample_data/{name} ")
    ).split()
    options: dict = {"effects": [], "rig": words[words.index("--rig") + 1]}
    for flag, value in pairwise(words):
        if flag == "--set":
            options[value.partition("=")[0]] = value.partition("=")[2]
        elif flag in ("--format", "--seed"):
            options[flag[2:]] = value
        elif flag == "--effect":
            options["effects"].append(value)
    simulate_campaign(tmp_path / "raw", **options)
    made = sorted(p.relative_to(tmp_path / "raw") for p in (tmp_path / "raw").rglob("*") if p.is_file())
    assert made == sorted(p.relative_to(SAMPLES / name) for p in (SAMPLES / name).rglob("*") if p.is_file())
    step = 2.0 / 2**18
    for file in made:
        if file.suffix == ".toml":
            assert (SAMPLES / name / file).read_text() == (tmp_path / "raw" / file).read_text()
        elif file.suffix == ".h5":
            stored, fresh = read_h5(SAMPLES / name / file), read_h5(tmp_path / "raw" / file)
            for channel, volts in stored.items():  # another FFT may round one sample to the next code
                np.testing.assert_allclose(fresh[channel], volts, atol=1.5 * step, err_msg=channel)


def test_a_rig_with_hardly_any_nonlinearity_answers_like_the_linear_one() -> None:
    from ema_pipeline.effects.rig import rig_with_effects

    history = ForceHistory((Pulse(0.05, 150.0, 6e-4),), 5120.0, 5120)
    sensors, impact = default_sensors(RIG.assembly("no_ring")), Dof("sun", "y")
    slight = rig_with_effects(RIG, [("bearing_cubic@sun", {"stiffness": 1.0})]).assembly("no_ring")
    ((f1, linear),) = linear_response(RIG.assembly("no_ring"), (history,), impact, sensors)
    ((f2, stepped),) = integrated_response(slight, (history,), impact, sensors)
    np.testing.assert_allclose(f2, f1, atol=2e-4 * f1.max())
    assert np.max(np.abs(stepped - linear)) < 1e-3 * np.max(np.abs(linear))


def test_cubic_bearing_shifts_the_simulated_resonance_with_the_force(tmp_path: Path) -> None:
    simulate_campaign(
        tmp_path, "planetary", configurations=["no_ring"], effects=["bearing_cubic@sun:stiffness=2e13"],
        sensors=["sun.x"], impacts=["sun.x"], peak_force_n=(10.0, 400.0), hits=1, duration_s=1.0,
        force_spread=0.0, format="hdf5",
    )  # fmt: skip
    peaks = []
    for level in ("10N", "400N"):
        record = read_h5(next(tmp_path.glob(f"*{level}*.h5")))
        gain = np.abs(np.fft.rfft(record["sun_x"])) / np.abs(np.fft.rfft(record["hammer"]))
        f = np.fft.rfftfreq(len(record["sun_x"]), 1 / 5120.0)
        band = (f > 95) & (f < 140)
        peaks.append(f[band][np.argmax(gain[band])])
    assert peaks[1] > peaks[0] + 0.5
