"""Continuous tests as a user runs them: from the raw folder to the claim, and bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench import ema as command
from continuous_cases import RIG, write_oscillator
from typer.testing import CliRunner

import ema_pipeline as ema
from ema_pipeline.cli import app
from ema_pipeline.ingest.driven import AT_LIMIT, _at_limits, _piled_up
from ema_pipeline.ingest.lost_samples import frozen_stretch
from ema_pipeline.ingest.pulse import step_of

RUNNER = CliRunner()

pytestmark = pytest.mark.usefixtures("without_figures")


def _run(raw: Path, out: Path, rig: Path | None = None) -> dict:
    given = ["--rig", str(rig)] if rig else []
    found = RUNNER.invoke(app, ["run", str(raw), *given, "--out", str(out), "--quiet"])
    assert found.exit_code == 0, found.output
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow
def test_a_hidden_cubic_spring_is_named_with_its_size(tmp_path: Path) -> None:
    raw = write_oscillator(tmp_path / "raw", lambda x, v: 3e9 * x**3, samples=(1536, 1024))
    (tmp_path / "rig.toml").write_text(RIG)
    found = _run(raw, tmp_path / "out", tmp_path / "rig.toml")
    claimed = [c for c in found["diagnosis"]["candidates"] if c["claimed"]]
    assert [f"{c['effect']}@{c['at']}" for c in claimed] == ["cubic_spring@mass.x"]
    assert found["diagnosis"]["verdict"] == "effect"
    assert claimed[0]["probability"] > 0.99
    size = claimed[0]["parameters"]["stiffness"]
    assert abs(size["value"] - 3e9) < 3 * size["std"] < 0.3 * 3e9
    assert [r["effects"] for r in found["ladder"]] == [[], ["cubic_spring@mass.x"]]
    two = found["simulation"]["records"]["two"]
    assert (two["use"], two["unit"], two["samples"]) == ("held_out", "m", 1024 - 50)
    assert two["relative"] < 0.008
    assert two["rmse"] < 0.2 * two["rmse_without_effects"]
    mass = found["ladder"][-1]["parameters"]["mass (mass)"]
    assert mass["unit"] == "kg"
    assert abs(mass["value"] - 2.0) < 3 * mass["std"]


@pytest.mark.slow
def test_fitted_parameters_are_shown_of_the_model_in_use_and_of_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = write_oscillator(tmp_path / "raw", lambda x, v: 3e9 * x**3, samples=(1024, 512))
    (tmp_path / "rig.toml").write_text(RIG)
    out, stages = tmp_path / "out", 'stages=["ingest", "frf", "modal", "ladder", "report"]'
    assert command(capsys, "run", raw, "--rig", tmp_path / "rig.toml", "--out", out, "--set", stages)[0] == 0
    code, text, _ = command(capsys, "fit", out)
    assert (code, text) == (0, f"The model in use has not been fitted yet; 'ema diagnose {out}' does that.\n")
    assert command(capsys, "add", out, "cubic_spring@mass.x")[0] == 0
    code, text, _ = command(capsys, "fit", out)
    assert code == 0
    shown = json.loads((out / "summary.json").read_text())["ladder"][-1]["parameters"]
    names = ["mass", "mass spring x", "modal damping ratio", "cubic spring at mass.x, stiffness"]
    assert len(shown) == len(names)
    assert all(name in text for name in names)
    assert "GN/m³" in text
    code, text, err = command(capsys, "fit", out, "--save", tmp_path / "saved.toml")
    assert code == 1
    assert "are not saved; copy the values that 'ema fit' shows" in err
    assert command(capsys, "remove", out, "cubic_spring@mass.x")[0] == 0
    assert "has not been fitted yet" in command(capsys, "fit", out)[1]


@pytest.mark.slow
def test_without_a_rig_the_modes_are_the_linear_model_and_a_linear_one_is_adequate(tmp_path: Path) -> None:
    raw = write_oscillator(tmp_path / "raw", lambda x, v: 0.0, samples=(1536, 1024))
    found = _run(raw, tmp_path / "out")
    assert found["diagnosis"]["verdict"] == "adequate"
    assert found["diagnosis"]["nothing_missing_probability"] > 0.8
    assert found["simulation"]["records"]["two"]["relative"] < 0.008
    modes = found["configurations"]["default"]["modes"]
    assert len(modes) == 1
    records = found["configurations"]["default"]["records"]
    assert (records["used"], records["found"]) == (2, 2)
    assert abs(modes[0]["frequency_hz"] - np.sqrt(5e4 / 2.0) / (2 * np.pi)) < 0.2


@pytest.mark.slow
def test_hidden_friction_is_named(tmp_path: Path) -> None:
    raw = write_oscillator(tmp_path / "raw", lambda x, v: 8.0 * np.tanh(v / 0.02))
    found = _run(raw, tmp_path / "out")
    claimed = [c["effect"] for c in found["diagnosis"]["candidates"] if c["claimed"]]
    assert claimed[:1] == ["dry_friction"]


DESCRIPTION = """kind = "continuous"
sample_rate_hz = 512.0
channels = [
  { name = "f", quantity = "force", unit = "N", dof = "mass.x" },
  { name = "x", quantity = "displacement", unit = "m", dof = "mass.x" },
]
[[records]]
file = "r.h5"
excitation = "multisine"
period_samples = 512
"""


def _folder(tmp_path: Path, text: str, samples: int = 1024) -> Path:
    force = np.tile(np.random.default_rng(0).standard_normal(512), -(-samples // 512))[:samples]
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["f"], file["x"] = force, 1e-3 * np.cumsum(force)
    (tmp_path / "test.toml").write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('quantity = "force", unit = "N", dof = "mass.x"', 'quantity = "velocity", unit = "m/s", dof = "b.x"'),
         "no force channel"),
        (('unit = "N", dof = "mass.x"', 'unit = "N"'), "channel 'f': has no dof"),
        (('unit = "m", dof = "mass.x"', 'unit = "m"'), "response channel 'x' has no dof"),
        (("period_samples = 512", "period_samples = 500"), "period_samples = 500 does not fit 1024 samples"),
        (("period_samples = 512", "period_samples = 256"), "the force differs by"),
        (("period_samples = 512", "period_samples = 4096"), "period_samples = 4096, but it has 1024 samples"),
        (("period_samples = 512", "last_sample = 99"), "at least 256 are needed: record longer"),
        (("period_samples = 512", "last_sample = 9999"), "last_sample = 9999, but the file holds"),
        (("period_samples = 512", 'impact = "mass.x"'), "a continuous record has no impact"),
        (('"multisine"', '"random"'), "has no period"),
    ],
)  # fmt: skip
def test_bad_descriptions_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str], words: str
) -> None:
    _one_line(capsys, _folder(tmp_path, DESCRIPTION.replace(*change)), words)


def _one_line(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> None:
    """Both `check` and `run` end with one line on stderr that names the folder's file and holds the words."""
    for verb in (("check", folder), ("run", folder, "--out", folder / "out")):
        code, _, err = command(capsys, *verb)
        assert code == 1
        assert err.count("\n") == 1
        assert err.startswith(f"ema: {folder}")
        assert all(w in err for w in words)


@pytest.mark.parametrize(("channel", "share"), [("f", 0.3), ("x", 0.6)])
def test_a_clipped_channel_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], channel: str, share: float
) -> None:
    folder = _folder(tmp_path, DESCRIPTION, samples=8192)
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        limit = share * np.max(np.abs(file[channel][:]))
        file[channel][:] = np.clip(file[channel][:], -limit, limit)
    _one_line(capsys, folder, f"channel '{channel}': is clipped at {limit:.3g}", "with a larger range")


def test_noise_that_piles_up_at_a_limit_is_clipped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With power up to half the sample rate it stays there for a sample or two at a time: no top of it is flat."""
    folder = _folder(tmp_path, DESCRIPTION.replace("period_samples = 512", ""), samples=8192)
    force = np.clip(np.random.default_rng(3).standard_normal(8192), -2.5, 2.5)
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        file["f"][:] = force
    assert _at_limits(force) < AT_LIMIT
    _one_line(capsys, folder, "channel 'f': is clipped at 2.5", "with a larger range")


def test_a_spike_in_a_response_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One lone sample would raise the whole spectrum."""
    folder = _folder(tmp_path, DESCRIPTION, samples=8192)
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        largest = np.max(np.abs(file["x"][:]))
        file["x"][900] = 20 * largest
    _one_line(capsys, folder, "channel 'x': sample 900 is", "a spike, no motion; record again")


@pytest.mark.parametrize("channel", ["f", "x"])
@pytest.mark.parametrize(("start", "stop"), [(3000, 3100), (7000, 8192), (0, 300)])
def test_a_channel_that_stood_still_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], channel: str, start: int, stop: int
) -> None:
    """The recorder went on with the last value: force and response no longer belong together."""
    folder = _folder(tmp_path, DESCRIPTION.replace("period_samples = 512", ""), samples=8192)
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        held = np.median(file[channel][:]) + 0.5 * np.std(file[channel][:])
        file[channel][start:stop] = held
    said = f"channel '{channel}': stands at {held:.4g} from sample {start} to {stop - 1}"
    _one_line(capsys, folder, said, "samples were lost", "first_sample and last_sample")


def test_what_rests_on_purpose_has_lost_nothing() -> None:
    """Bursts with nothing between them, holds of a random staircase, and the calm before and after."""
    random = np.random.default_rng(6)
    noise = random.standard_normal(4096)
    staircase = np.repeat(random.standard_normal(64), 64)
    calm = np.concatenate([np.zeros(500), noise, np.zeros(500)])
    quiet = np.round(3 * np.sin(2 * np.pi * 1e-4 * np.arange(40_000)))  # slower than the converter's steps
    for samples in (noise, staircase, calm, quiet):
        assert frozen_stretch(samples, step_of(samples)) == (0, 0)
    bursts = np.where(np.arange(4096) % 1024 < 700, noise, 0.0)
    start, stop = frozen_stretch(bursts, step_of(bursts))
    assert (stop - start, bursts[start]) == (324, 0.0)  # a force may rest at 0, a response may not


@pytest.mark.parametrize("steps", [12, 200])
def test_signals_in_steps_of_a_converter_are_not_clipped(steps: int) -> None:
    sine = np.round(steps * np.sin(2 * np.pi * 0.4123 * np.arange(20_000)))
    noise = np.round(steps / 4 * np.random.default_rng(4).standard_normal(20_000))
    assert not _piled_up(sine)
    assert not _piled_up(noise)
    computed = np.sin(np.random.default_rng(5).uniform(0, 2 * np.pi, 20_000))
    computed[::700] = 1.0  # a sweep whose samples meet its amplitude exactly now and then
    assert not _piled_up(computed)
    assert _piled_up(np.clip(sine, -np.inf, 0.6 * steps))


@pytest.mark.slow
def test_a_model_of_modes_that_grows_without_bound_says_what_to_look_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = _folder(
        tmp_path, DESCRIPTION.replace("period_samples = 512", "")
    )  # a displacement that wanders off
    code, _, err = command(capsys, "run", folder, "--out", tmp_path / "out", "--quiet")
    assert code == 1
    assert err.count("\n") == 1
    assert "a sensor that drifts" in err


@pytest.mark.slow
def test_silverbox(test_data: Path, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    found = _run(test_data / "realdata" / "silverbox", tmp_path / "out", tmp_path / "rig.toml")
    assert found["ladder"][1]["effects"] == ["cubic_spring@mass.x"]
    assert found["ladder"][2]["effects"][1] == "quadratic_spring@mass.x"
    records = found["simulation"]["records"]
    assert records["multisine"]["rmse"] < 0.29e-3
    assert records["arrow"]["rmse"] < 0.42e-3


@pytest.mark.slow
def test_bouc_wen(test_data: Path, tmp_path: Path) -> None:
    found = _run(test_data / "realdata" / "bouc_wen", tmp_path / "out")
    claimed = [c["effect"] for c in found["diagnosis"]["candidates"] if c["claimed"]]
    assert claimed == ["hysteresis"]
    records = found["simulation"]["records"]
    assert records["multisine"]["rmse"] < 1e-6
    assert records["sweep"]["rmse"] < 5e-6
    (loop,) = found["simulation"]["hysteresis"]
    assert loop["energy_per_cycle_j"] > 5 * loop["energy_per_cycle_std_j"] > 0


@pytest.mark.slow
@pytest.mark.usefixtures("all_cores")
def test_the_python_interface_reads_identifies_and_diagnoses(tmp_path: Path) -> None:
    test = ema.read(write_oscillator(tmp_path / "raw", lambda x, v: 3e9 * x**3, samples=(1024, 512)))
    assert isinstance(test, ema.ContinuousTest)
    (one, two) = test.records["default"]
    assert one.force.shape == (1, 1024)
    assert two.held_out
    assert list(test.table()["drives"]) == ["mass.x", "mass.x"]
    assert "1 held out" in test._repr_html_()
    assert test.plot().get_ylabel().endswith("N²/Hz")
    modes = ema.identify(test.frfs())
    (tmp_path / "rig.toml").write_text(RIG)
    found = ema.diagnose(tmp_path / "rig.toml", modes, settings={"diagnose.most_effects": 1})
    assert [c.label for c in found.candidates if c.claimed] == ["cubic_spring@mass.x"]
