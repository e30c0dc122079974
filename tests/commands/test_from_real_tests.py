"""What real tests brought to light, each as a user meets it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench import ema, write_bench
from scipy.io import savemat

from ema_pipeline.rigs import load_rig

STAGES = 'stages=["ingest", "hits", "frf", "modal", "ladder", "fit", "correlate"]'
FRAME = 'base = "frame"\n[geometry]\nstoreys = 3\n'


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bench(tmp_path_factory.mktemp("bench"), values={"k2": 4.4e5})


def test_a_fit_is_saved_as_a_rig_with_its_intervals_as_tolerances(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, saved = tmp_path / "out", tmp_path / "fitted.toml"
    assert ema(capsys, "run", bench, "--out", out, "--set", STAGES)[0] == 0
    code, text, err = ema(capsys, "fit", out, "--save", saved)
    assert code == 0, err
    assert re.search(r"k2 +\d+\.?\d* ± \d", text)
    rig = load_rig(str(saved))
    fitted = json.loads(ema(capsys, "fit", out, "--json")[1])["fit"]["parameters"]["k2"]
    k2 = rig.parameters["k2"]
    assert k2.value == pytest.approx(fitted["value"], rel=1e-6)
    assert k2.tolerance == pytest.approx(fitted["std"] / fitted["value"], rel=1e-2)
    assert abs(k2.value - 4.4e5) < 3 * fitted["std"]
    assert rig.parameters["k1"].unit == "N/m"
    before = (out / "ema.h5").read_bytes()
    code, _, err = ema(capsys, "fit", out, "--set", "fit.sweep_points=50", "--save", saved)
    assert code == 1
    assert "exists already" in err
    assert (out / "ema.h5").read_bytes() == before  # nothing was fitted


def test_two_identical_records_are_noticed(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "raw"
    shutil.copytree(bench, raw)
    first, second = sorted(raw.glob("m1_x*"))[:2]
    shutil.copyfile(first, second)
    code, out, _ = ema(capsys, "run", raw, "--out", tmp_path / "out", "--set", STAGES)
    assert code == 0
    told = f"{second.name} holds the same force record as {first.name}, bit for bit"
    assert told in " ".join(out.split())


def test_nothing_is_dropped_without_a_line_that_says_so(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "raw"
    shutil.copytree(bench, raw)
    record = sorted(raw.glob("m3_x*"))[0]
    with h5py.File(record, "r+") as file:
        (dataset,) = (file[name] for name in file if name.endswith("m2_x"))
        dataset[...] = np.full(dataset.shape, 0.25)
    code, out, _ = ema(capsys, "run", raw, "--out", tmp_path / "out", "--set", STAGES)
    assert code == 0
    assert "channel 'm2_x' was left out of 1 of 6 hits: m2_x is constant at" in " ".join(out.split())


def test_no_channel_of_the_shipped_demo_is_called_clipped(capsys: pytest.CaptureFixture[str]) -> None:
    demo = Path(__file__).parents[2] / "sample_data" / "hidden_effect"
    code, out, _ = ema(capsys, "check", demo)
    assert code == 0
    assert re.findall(r"clipping +≤ \S+ % +\S+ % +(\S+)", out) == ["PASS", "PASS"]
    assert "left out" not in out


def test_a_warning_is_not_shown_as_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = write_bench(tmp_path, contact_s=8e-3, hits=1)  # too soft a tip: the force fades within the band
    code, out, _ = ema(capsys, "check", raw)
    assert code == 0
    assert re.search(r"force spectrum .* warn 2 of 2", out)
    assert "FAIL" not in out
    assert not [line for line in out.splitlines() if line.startswith("!")]


def test_volts_of_an_uncalibrated_hammer_are_shown_as_volts(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "raw"
    shutil.copytree(bench, raw)
    toml = raw / "test.toml"
    text = re.sub(r'unit = "N"\nsensitivity_mv = .*', 'unit = "V"\nuncalibrated = true', toml.read_text())
    toml.write_text(re.sub(r"(uncalibrated = true\n)full_scale_v = .*\n", r"\1", text), encoding="utf-8")
    code, out, err = ema(capsys, "check", raw)
    assert code == 0, err
    assert re.search(r"m1\.x +0\.\d+ V ", out)
    assert not re.search(r"m1\.x +[\d.]+ N ", out)
    measured = 'stages=["ingest", "hits", "frf", "modal", "levels"]'
    code, _, err = ema(capsys, "run", raw, "--out", tmp_path / "out", "--set", measured, "-q")
    assert code == 0, err
    code, out, err = ema(capsys, "levels", tmp_path / "out")
    assert code == 0, err
    assert re.search(r"one force level \(about 0\.\d+ V\)", out)


def test_a_setting_in_the_wrong_table_is_found(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ema(capsys, "run", bench, "--set", "modal.low_hz=3")
    assert code == 1
    assert "did you mean modal.identify.low_hz?" in err


def test_init_leaves_windowed_copies_and_impulse_responses_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    time = np.arange(4096) / 4096
    force = np.where(time < 2e-3, np.sin(np.pi * time / 2e-3), 0.0) + 1e-5 * rng.standard_normal(time.size)
    impulse = np.exp(-12 * time) * np.sin(2 * np.pi * 90 * time)
    answer = np.fft.irfft(np.fft.rfft(force) * np.fft.rfft(impulse), time.size)
    answer = answer + 1e-5 * rng.standard_normal(time.size)
    window = np.exp(-3 * time)
    units = {"X1": "N", "W1": "N", "X2": "g", "W2": "g", "Z1_2": "N"}
    data = {"X1": force, "W1": force * window, "X2": answer, "W2": answer * window, "Z1_2": impulse}
    columns = [f"{name} [{unit}]" for name, unit in units.items()]
    table = np.column_stack([time, *data.values()])
    header = ",".join(["time [s]", *columns])
    np.savetxt(tmp_path / "run1.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
    code, _, err = ema(capsys, "init", tmp_path)
    assert code == 0, err
    text = (tmp_path / "test.toml").read_text(encoding="utf-8")
    assert re.findall(r'^name = "(.*)"', text, flags=re.MULTILINE) == ["X1", "X2"]
    assert "\"W1\" is a copy of 'X1' under a window" in text
    assert '"Z1_2" is an impulse response' in text


def test_init_does_not_invent_a_sample_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(2)
    pulse = np.where(np.arange(2000) // 10 == 20, 1.0, 0.0) + 1e-3 * rng.standard_normal(2000)
    savemat(tmp_path / "run1.mat", {"hammer": pulse, "a": rng.standard_normal(2000)})
    assert ema(capsys, "init", tmp_path)[0] == 0
    text = (tmp_path / "test.toml").read_text(encoding="utf-8")
    assert "25600" not in text
    assert "sample_rate_hz =    # CHECK" in text


@pytest.mark.slow
def test_a_table_of_modes_rounded_coarser_than_its_deviations_is_noticed_and_nobody_is_told_to_hit_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text(FRAME, encoding="utf-8")
    model = json.loads(ema(capsys, "model", "--rig", tmp_path / "rig.toml", "--json")[1])["modes"]
    wrong = [round(m["frequency_hz"] * f, 1) for m, f in zip(model, (1.3, 0.8, 1.1), strict=False)]
    table = tmp_path / "modes.toml"
    table.write_text(f"[default]\nfrequency_hz = {wrong}\nfrequency_std_hz = 0.001\n", encoding="utf-8")
    stages = 'stages=["modal", "ladder", "diagnose", "fit", "correlate"]'
    rig = ("--rig", tmp_path / "rig.toml", "--out", tmp_path / "out")
    once = ("--set", "diagnose.most_effects=1")
    code, out, err = ema(capsys, "run", "--modes", table, *rig, "--set", stages, *once, "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert any(
        "finer than the rounding of the table's numbers: 0.029 Hz is taken" in w for w in summary["warnings"]
    )
    stds = [m["frequency_std_hz"] for m in summary["configurations"]["default"]["modes"]]
    assert stds == pytest.approx([0.1 / np.sqrt(12)] * 3)
    assert "Hit at" not in summary["diagnosis"]["next_measurement"]
