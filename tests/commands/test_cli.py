"""The command line: what users type, what they get, and what they are told when something is wrong."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyuff
from bench import ema, write_bench

from ema_pipeline.loops.simulate import PRINTED, write_sine_tests
from ema_pipeline.run.opening import existing_run
from ema_pipeline.simulate import simulate_campaign

pytestmark = pytest.mark.usefixtures("without_figures")

STAGES = 'stages=["ingest", "hits", "frf", "modal", "ladder", "fit", "correlate", "report"]'
"""All but the diagnosis, which takes longest and has tests of its own."""

RIG = ("--rig", "planetary", "--set", STAGES)
RUN = [sys.executable, "-m", "ema_pipeline.cli", "run"]


@pytest.fixture(scope="module")
def small_raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small healthy test without the ring: three sensors, two points, one hit each, CSV."""
    raw = tmp_path_factory.mktemp("raw") / "small"
    simulate_campaign(
        raw,
        "planetary",
        configurations=["no_ring"],
        sensors=["carrier.x", "sun.y", "planet1.x", "planet1.u"],
        impacts=["carrier.x", "planet1.u"],
        hits=1,
        duration_s=1.0,
        format="csv",
        seed=3,
    )
    return raw


@pytest.fixture(scope="module")
def results(small_raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a run on the small test."""
    out = tmp_path_factory.mktemp("out") / "small"
    command = [*RUN, str(small_raw), *RIG, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "report.html" in done.stdout
    return out


def test_a_run_writes_every_file_of_the_results_folder(results: Path) -> None:
    names = {p.name for p in results.iterdir()}
    assert {"ema.h5", "report.html", "modes.csv", "summary.json"} <= names
    assert "plots" not in names  # drawn on demand


def test_the_summary_holds_modes_near_those_of_the_model_that_made_the_data(
    results: Path, small_raw: Path
) -> None:
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    truth = json.loads((small_raw / "truth.json").read_text(encoding="utf-8"))
    true_hz = np.array([m["frequency_hz"] for m in truth["configurations"]["no_ring"]["modes"]])
    modes = summary["configurations"]["no_ring"]["modes"]
    assert len(modes) >= 8
    for mode in modes:
        nearest = true_hz[np.argmin(np.abs(true_hz - mode["frequency_hz"]))]
        assert mode["frequency_hz"] == pytest.approx(nearest, rel=2e-3)
        assert mode["model_frequency_hz"] == pytest.approx(nearest, rel=2e-3)
        assert mode["frequency_std_hz"] > 0
        assert mode["damping_ratio"] == pytest.approx(0.01, rel=0.1)
    mesh = summary["fit"]["parameters"]["sun_planet_mesh_stiffness"]
    assert mesh["identified"]
    assert abs(mesh["value"] - truth["values"]["sun_planet_mesh_stiffness"]) < 3 * mesh["std"]
    assert summary["fit"]["parameters"]["ring_planet_mesh_stiffness"]["value"] is None
    assert summary["configurations"]["no_ring"]["records"]["used"] == 2


def test_an_unchanged_second_run_computes_nothing(
    results: Path, small_raw: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (results / "ema.h5").stat().st_mtime_ns
    code, out, err = ema(capsys, "run", small_raw, *RIG, "--out", results)
    assert code == 0
    assert "Nothing had changed" in out
    assert err == ""
    assert (results / "ema.h5").stat().st_mtime_ns == before


def test_a_changed_setting_recomputes_only_what_depends_on_it(
    results: Path, small_raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    code, text, _ = ema(
        capsys,
        "run",
        small_raw,
        *RIG,
        "--out",
        out,
        "--verbose",
        "--set",
        "correlate.pairing.least_mac=0.45",
    )
    assert code == 0
    assert "Computed: correlate, report\n" in text


def test_report_for_print_has_eight_pages_at_most_and_the_test_sheet(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    code, text, err = ema(capsys, "report", out, "--pdf")
    assert code == 0, err
    assert "report.pdf" in text
    pages = (out / "report.pdf").read_bytes()
    assert pages.startswith(b"%PDF")
    assert 3 <= len(re.findall(rb"/Type /Page\b(?!s)", pages)) <= 8
    html = (out / "report.html").read_text(encoding="utf-8")
    sheet = html[html.index("Set-up and processing") :]
    for item in ("impact points", "sample rate", "exponential window", "mV/", "ISO 7626-5"):
        assert item in sheet


def test_a_report_without_the_large_results_says_that_they_are_gone(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    monkeypatch.setattr("ema_pipeline.store.LARGE_BYTES", 0)
    assert ema(capsys, "frf", out, "--set", "frf.estimator=H2")[0] == 0
    (part,) = (out / "stages").iterdir()
    part.unlink()
    assert ema(capsys, "report", out)[0] == 0
    warnings = json.loads((out / "summary.json").read_text(encoding="utf-8"))["warnings"]
    assert any(w.startswith(f"stages/{part.name} is not in the folder") for w in warnings)


def test_a_folder_that_cannot_be_written_to_is_read_where_nothing_has_changed(
    results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = ema(capsys, "compare", results)

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("ema_pipeline.store.FileLock.acquire", refuse)
    assert ema(capsys, "compare", results) == told
    code, _, err = ema(capsys, "frf", results, "--set", "frf.estimator=H2")
    assert code == 1
    assert err.endswith(
        "cannot be written to, and settings would change there; copy the folder to where you can write\n"
    )
    code, _, err = ema(capsys, "add", results, "spring@sun.x")
    assert code == 1
    assert "cannot write results there (Read-only file system)" in err


def test_stages_run_alone_on_a_results_folder_without_the_raw_data(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    code, text, _ = ema(capsys, "frf", out, "--set", "frf.estimator=H2")
    assert code == 0
    assert text == "Computed: frf (no_ring)\n"
    with h5py.File(out / "ema.h5") as file:
        assert file["stages/frf/no_ring/frfs"].attrs["estimator"] == b"H2"


def test_compare_shows_each_mode_with_its_difference(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = ema(capsys, "compare", results)
    assert code == 0
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    for mode in summary["configurations"]["no_ring"]["modes"]:
        assert f"{int(mode['frequency_hz'])}." in out


def test_an_effect_is_added_under_a_changed_setting_and_removed_and_the_ladder_shows_what_it_brought(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    effect = "shaft_torsion@carrier"
    code, text, _ = ema(capsys, "add", out, effect, "--set", "diagnose.folds=3", "--quiet")
    assert (code, text) == (0, "")
    assert json.loads(existing_run(out).info.pipeline)["diagnose"]["folds"] == 3
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [rung["effects"] for rung in summary["ladder"]] == [[], [effect]]
    assert summary["ladder"][1]["error"] <= summary["ladder"][0]["error"] + 1e-3  # nothing is missing
    assert f"{effect}.stiffness" in summary["fit"]["parameters"]
    code, text, _ = ema(capsys, "ladder", out)
    assert code == 0
    assert "shaft torsion" in text
    damper = "local_damper@sun"  # calls for a scatter that the diagnosis had no need of
    code, text, _ = ema(capsys, "add", out, damper)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert code == 0
    assert f"{damper}.coefficient" in summary["fit"]["parameters"]
    told = re.search(r"\(error ([\d.]+)\)", " ".join(text.split()))
    assert told is not None
    assert float(told[1]) == pytest.approx(summary["ladder"][2]["error"], rel=0.01)
    code, text, _ = ema(capsys, "remove", out, damper, "--quiet", "--json")
    assert code == 0
    assert [rung["effects"] for rung in json.loads(text)["ladder"]] == [[], [effect]]
    code, text, _ = ema(capsys, "remove", out, effect)
    assert code == 0
    report = re.escape(str(out / "report.html"))
    assert re.fullmatch(
        rf"Fit, comparison and report now use the base model \(error [\d.]+\)\.\nReport: {report}\n", text
    )
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert f"{effect}.stiffness" not in summary["fit"]["parameters"]


@pytest.mark.slow
def test_a_diagnosis_of_a_model_is_dropped_with_an_effect_that_it_had(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    effect = "shaft_torsion@carrier"
    for verb in (("add", out, effect), ("diagnose", out)):
        assert ema(capsys, *verb)[0] == 0
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["diagnosis"]["on_top_of"] == [
        effect
    ]
    assert ema(capsys, "remove", out, effect)[0] == 0
    assert "diagnosis" not in json.loads((out / "summary.json").read_text(encoding="utf-8"))
    code, text, _ = ema(capsys, "ladder", out)
    assert (code, "shaft torsion" in text) == (0, False)


def test_verbose_says_what_a_fit_computed(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = ema(capsys, "fit", results, "--verbose")
    assert code == 0
    assert text.endswith("\nNothing had changed.\n")
    assert "Nothing had changed" not in ema(capsys, "fit", results)[1]


def test_an_effect_that_does_not_exist_is_refused_and_changes_nothing(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (results / "ema.h5").read_bytes()
    for wrong in ("shaft_torsoin@carrier", "shaft_torsion@moon", "shaft_torsion", "sensor_mass@"):
        assert_one_clear_line(*ema(capsys, "add", results, wrong))
    assert_one_clear_line(*ema(capsys, "remove", results, "shaft_torsion@carrier"))
    assert (results / "ema.h5").read_bytes() == before


def test_an_effect_that_one_force_level_cannot_show_is_refused_before_it_is_added(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = ema(capsys, "add", results, "cubic_spring@sun.y")
    assert code == 1
    assert (
        "'cubic_spring@sun.y' shows in hits at several force levels only, and there are none: strike with"
        in err
    )
    assert "ema remove" not in err


def test_the_live_page_of_a_folder_without_results_says_how_to_make_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = ema(capsys, "view", tmp_path / "nope", "--no-browser")
    assert_one_clear_line(code, out, err)
    assert "nope: holds no ema.h5; make one with 'ema run RAW --out" in err


def test_exported_files_are_read_by_another_program(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, err = ema(capsys, "export", results, "--to", tmp_path / "export")
    assert code == 0, err
    assert len(text.splitlines()) == 3
    sets = pyuff.UFF(str(tmp_path / "export" / "no_ring.uff")).read_sets()
    kinds = [s["type"] for s in sets]
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    frequencies = {m["frequency_hz"] for m in summary["configurations"]["no_ring"]["modes"]}
    assert kinds.count(55) == 2 * len(frequencies)  # as real and as complex shapes
    frf = next(s for s in sets if s["type"] == 58)
    assert np.iscomplexobj(frf["data"])


def test_export_replaces_files_in_the_results_folder_only(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "no_ring_shapes.csv"
    mine.write_text("mine", encoding="utf-8")
    code, out, err = ema(capsys, "export", results, "--to", tmp_path)
    assert_one_clear_line(code, out, err)
    assert f"{mine}: exists already and is kept; name another folder with --to" in err
    assert [p.name for p in tmp_path.iterdir()] == [mine.name]
    assert mine.read_text(encoding="utf-8") == "mine"
    own = results / "export" / mine.name
    own.parent.mkdir(exist_ok=True)
    own.write_text("of an earlier run", encoding="utf-8")
    assert ema(capsys, "export", results)[0] == 0
    assert own.read_text(encoding="utf-8").startswith("configuration,mode,")


def test_a_table_of_modes_takes_the_place_of_raw_data(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "case1.toml"
    table.write_text("schema = 1\n[no_ring]\nfrequency_hz = [62.5, 85.7, 134.0]\n", encoding="utf-8")
    out = tmp_path / "out"
    code, text, err = ema(capsys, "run", "--modes", table, *RIG, "--out", out)
    assert code == 0, err
    assert "not identified" in text
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    mesh = summary["fit"]["parameters"]["sun_planet_mesh_stiffness"]
    assert (mesh["identified"], mesh["value"]) == (False, None)
    assert [m["frequency_hz"] for m in summary["configurations"]["no_ring"]["modes"]] == [62.5, 85.7, 134.0]
    assert (out / "report.html").exists()


@pytest.mark.slow
def test_hysteresis_tests_run_through_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {name: PRINTED[name] for name in ("stiffness", "viscous_damping")}
    write_sine_tests(tmp_path / "raw", values, (10.0, 15.0), (1e-3, 2e-3))
    out = tmp_path / "out"
    once = ("--set", "diagnose.most_effects=1")
    code, text, err = ema(capsys, "run", tmp_path / "raw", "--out", out, *once)
    assert code == 0, err
    assert "viscous damping" in text
    found = json.loads((out / "summary.json").read_text(encoding="utf-8"))["configurations"]["default"]
    assert found["parameters"]["stiffness"]["value"] == pytest.approx(PRINTED["stiffness"], rel=0.03)
    shown = ema(capsys, "fit", out)[1]
    assert "Parameters of the base model" in shown
    assert re.search(r"stiffness +[\d.]+ ± [\d.]+ kN/m", shown)
    assert ema(capsys, "report", out, "--plots")[0] == 0
    assert {p.suffix for p in (out / "plots").iterdir()} == {".png", ".svg"}


def test_the_papers_tables_are_reproduced(capsys: pytest.CaptureFixture[str]) -> None:
    code, text, _ = ema(capsys, "reproduce", "planetary")
    assert code == 0
    assert "1395" in text
    assert ema(capsys, "reproduce", "planetry")[0] == 1


def test_check_shows_a_verdict_table_and_writes_nothing(
    small_raw: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(p.name for p in small_raw.iterdir())
    code, out, _ = ema(capsys, "check", small_raw)
    assert code == 0
    assert "carrier" in out
    assert sorted(p.name for p in small_raw.iterdir()) == before


def test_model_lists_the_parameters_of_a_rig(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = ema(capsys, "model", "--rig", "planetary", "--parameters")
    assert code == 0
    rows = {line.split()[0]: " ".join(line.split()[1:]) for line in out.splitlines() if line.strip()}
    assert rows["planet_mass"] == "0.43 kg 1 % – 0 … ∞"
    assert rows["sun_planet_mesh_stiffness"] == "10 MN/m free – 1 … 1000"
    assert rows["pressure_angle_deg"] == "20 deg exact – 0 … 45"
    assert max(map(len, out.splitlines())) <= 80
    code, out, _ = ema(capsys, "model", "--rig", "planetary", "--parameters", "--json")
    told = {p["name"]: p for p in json.loads(out)["parameters"]}
    assert told["planet_mass"] == {
        "name": "planet_mass", "value": 0.43, "unit": "kg", "tolerance": 0.01, "scatter": None, "min": 0.0, "max": None,
    }  # fmt: skip
    assert told["sun_planet_mesh_stiffness"]["tolerance"] is None


def test_the_model_command_gives_the_seeds_frequencies_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = ema(capsys, "model", "--rig", "planetary", "--configuration", "no_ring", "--json")
    assert code == 0
    modes = json.loads(out)["modes"]
    frequencies = [m["frequency_hz"] for m in modes]
    for seed_hz in (51.1, 106.7, 113.9, 1395.0):
        assert min(abs(f - seed_hz) for f in frequencies) < 0.06
    assert {m["family"] for m in modes} >= {"rotational", "translational"}


def test_rigs_and_effects_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "planetary" in ema(capsys, "rigs")[1]
    code, out, _ = ema(capsys, "effects", "--rig", "planetary", "--json")
    assert code == 0
    listed = {e["id"]: e for e in json.loads(out)["effects"]}
    assert listed["mesh_stiffness_loss"]["places"] == [
        "sun-planet1",
        "sun-planet2",
        "ring-planet1",
        "ring-planet2",
    ]


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = ema(capsys, "--version")
    assert code == 0
    assert out.startswith("ema 0.")


def test_streams_that_a_daemon_has_closed_are_no_fault(tmp_path: Path) -> None:
    code = (
        "import os, sys; os.close(1); os.close(2); sys.stdout = sys.stderr = None;"
        "from ema_pipeline.cli import main; sys.argv = ['ema', 'simulate', 'raw', '--rig', 'frame']; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert done.returncode == 0
    assert (tmp_path / "raw" / "test.toml").is_file()


def test_a_current_folder_that_was_deleted_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lost = tmp_path / "lost"
    lost.mkdir()
    monkeypatch.chdir(lost)
    lost.rmdir()
    code, _, err = ema(capsys, "rigs")
    assert (code, err) == (1, "ema: the current folder was deleted: change to one that exists\n")


def test_an_empty_path_is_refused_and_nothing_is_written_to_the_current_folder(
    small_raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = ema(capsys, "run", small_raw, "--out", "")
    assert code == 1
    assert "the argument after --out is empty" in err
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_option_is_a_usage_error_with_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert ema(capsys, "run")[0] == 2
    assert ema(capsys, "run", "x", "--no-such-option")[0] == 2


def test_importing_the_package_loads_no_figure_window_and_little_else() -> None:
    code = (
        "import sys, ema_pipeline, ema_pipeline.cli\n"
        "heavy = {'matplotlib', 'tkinter', 'PyQt5', 'PyQt6', 'PySide6', 'pandas', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_run_loads_no_pyplot_and_no_window_toolkit(small_raw: Path) -> None:
    code = (
        "import sys, importlib, pkgutil, ema_pipeline\n"
        "for m in pkgutil.walk_packages(ema_pipeline.__path__, 'ema_pipeline.'):\n"
        "    importlib.import_module(m.name)\n"
        "windows = ('matplotlib.pyplot', 'tkinter', 'PyQt5', 'PyQt6', 'PySide6')\n"
        "print([n for n in windows if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_a_run_killed_again_and_again_ends_with_the_same_tables(
    small_raw: Path, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "killed"
    rng = np.random.default_rng(5)
    kills = 0
    for _ in range(10):
        process = subprocess.Popen([*RUN, str(small_raw), *RIG, "--out", str(out), "--quiet"])
        try:
            process.wait(float(rng.uniform(0.3, 1.8)))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
        if (out / "ema.h5").exists():
            with h5py.File(out / "ema.h5") as file:
                assert "run" in file
    assert kills >= 3
    code, _, err = ema(capsys, "run", small_raw, *RIG, "--out", out, "--quiet")
    assert (code, err) == (0, "")
    for name in ("summary.json", "modes.csv"):
        assert (out / name).read_bytes() == (results / name).read_bytes()
    assert not list(out.glob(".ema.h5*"))


# --- bad input ------------------------------------------------------------------------------------


def edit(path: Path, old: str, new: str) -> None:
    """Replace text that must be there."""
    text = path.read_text(encoding="utf-8")
    assert old in text, f"{old!r} is not in {path}"
    path.write_text(text.replace(old, new), encoding="utf-8")


def toml(old: str, new: str) -> Callable[[Path], None]:
    return lambda raw: edit(raw / "test.toml", old, new)


def record(raw: Path) -> Path:
    return sorted(raw.glob("carrier*.csv"))[0]


def replace_record(write: Callable[[Path], None]) -> Callable[[Path], None]:
    """Put another file in the place of the first record, under its name."""
    return lambda raw: write(record(raw))


def half_an_hdf5_file(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["hammer"] = np.zeros(100_000)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def half_a_uff_file(path: Path) -> None:
    lines = [
        "    -1",
        "    58",
        *["hammer"] * 5,
        "    1         0    0         0       NONE         1   1       NONE         1   1",
        "         2      1000         1  0.00000e+00  1.95313e-04  0.00000e+00",
        *["        17    0    0    0 NONE                 NONE"] * 4,
        "  1.0000E+00  2.0000E+00",
    ]
    path.write_text("\n".join(lines), encoding="ascii")


def zip_named_mat(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "nothing of use")


def put_nan(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    cells = lines[500].split(",")
    cells[-1] = "nan"
    lines[500] = ",".join(cells)
    path.write_text("\n".join(lines), encoding="utf-8")


def drop_column(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(line.rpartition(",")[0] for line in lines), encoding="utf-8")


def swap_hammer(raw: Path) -> None:
    path = raw / "test.toml"
    text = path.read_text(encoding="utf-8")
    text = text.replace('name = "hammer"', 'name = "@"').replace('name = "carrier_x"', 'name = "hammer"')
    path.write_text(text.replace('name = "@"', 'name = "carrier_x"'), encoding="utf-8")


def second_rate(raw: Path) -> None:
    edit(raw / "test.toml", "sample_rate_hz = 5120.0", "")
    path = record(raw)
    lines = path.read_text(encoding="utf-8").splitlines()
    fast = [lines[0]]
    for line in lines[1:]:
        time, _, rest = line.partition(",")
        fast.append(f"{float(time) / 2:.10g},{rest}")
    path.write_text("\n".join(fast), encoding="utf-8")


def silent_hammer(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("hammer")
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[column] = "0.0"
    path.write_text("\n".join([lines[0], *(",".join(r) for r in rows)]), encoding="utf-8")


# name → (what is done to the raw folder, what the one line must name)
BAD: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "empty record": (replace_record(lambda p: p.write_bytes(b"")), ("carrier",)),
    "binary junk": (replace_record(lambda p: p.write_bytes(bytes(range(256)) * 40)), ("carrier",)),
    "text without numbers": (replace_record(lambda p: p.write_text("hello\nworld\n")), ("carrier",)),
    "NaN in a record": (replace_record(put_nan), ("carrier",)),
    "missing column": (replace_record(drop_column), ("carrier",)),
    "truncated UFF": (replace_record(half_a_uff_file), ("carrier",)),
    "half an HDF5 file": (replace_record(half_an_hdf5_file), ("carrier",)),
    "zip renamed": (replace_record(zip_named_mat), ("carrier",)),
    "missing record": (lambda raw: record(raw).unlink(), ("carrier",)),
    "silent hammer": (replace_record(silent_hammer), ("hammer",)),
    "hammer and accelerometer swapped": (swap_hammer, ("hammer",)),
    "two sample rates": (second_rate, ("Hz",)),
    "wrong channel name": (toml('name = "sun_y"', 'name = "sun_z"'), ("sun_z",)),
    "unknown unit": (toml('unit = "N"', 'unit = "newtonish"'), ("newtonish", "hammer")),
    "unit of another quantity": (toml('unit = "N"', 'unit = "m"'), ("hammer",)),
    "volts without sensitivity": (
        toml('unit = "N"\nsensitivity_mv = 2.25', 'unit = "V"'),
        ("hammer", "sensitivity_mv"),
    ),
    "no unit": (toml('unit = "N"\n', ""), ("unit",)),
    "negative sensitivity": (toml("sensitivity_mv = 2.25", "sensitivity_mv = -2.25"), ("sensitivity_mv",)),
    "unknown quantity": (toml('quantity = "force"', 'quantity = "farce"'), ("farce",)),
    "no hammer": (
        toml('quantity = "force"\nunit = "N"', 'quantity = "acceleration"\nunit = "m/s^2"'),
        ("force",),
    ),
    "misspelt key": (toml("sample_rate_hz", "sample_rate"), ("sample_rate", "did you mean")),
    "sample rate against the file's": (toml("sample_rate_hz = 5120.0", "sample_rate_hz = 25600"), ("25600",)),
    "unknown dof": (toml('dof = "sun.y"', 'dof = "moon.y"'), ("moon.y",)),
    "dof of another form": (toml('dof = "sun.y"', 'dof = "sun"'), ("sun",)),
    "impact on an unknown dof": (toml('impact = "carrier.x"', 'impact = "carrier.q"'), ("carrier.q",)),
    "two sensors at one dof": (toml('dof = "sun.y"', 'dof = "carrier.x"'), ("carrier.x",)),
    "unknown configuration": (toml('configuration = "no_ring"', 'configuration = "noring"'), ("no_ring",)),
    "broken TOML": (toml("[[channels]]", "[[channels]"), ("TOML",)),
    "no records": (lambda raw: _cut(raw, "[[records]]"), ("records",)),
    "no test.toml": (lambda raw: (raw / "test.toml").unlink(), ("ema init",)),
    "later schema": (toml("schema = 1", "schema = 2"), ("schema",)),
    "record outside the folder": (toml('file = "', 'file = "../'), ("outside",)),
}


def _cut(raw: Path, marker: str) -> None:
    path = raw / "test.toml"
    path.write_text(path.read_text(encoding="utf-8").partition(marker)[0], encoding="utf-8")


def assert_one_clear_line(code: int, out: str, err: str) -> None:
    assert code == 1
    assert out == ""
    lines = err.strip().splitlines()
    messages = [line for line in lines if line.startswith("ema: ")]
    assert len(messages) == 1
    assert lines[-1] == messages[0]
    assert "Traceback" not in err
    assert "unexpected" not in err


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_line_and_leaves_nothing_behind(
    case: str, small_raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "raw"
    shutil.copytree(small_raw, raw)
    spoil, named = BAD[case]
    spoil(raw)
    code, out, err = ema(capsys, "run", raw, "--rig", "planetary", "--out", tmp_path / "out")
    assert_one_clear_line(code, out, err)
    for word in named:
        assert word in err, err
    assert not (tmp_path / "out" / "summary.json").exists()
    assert not (tmp_path / "out" / "report.html").exists()
    assert not list(tmp_path.glob("out/.*.tmp"))


def bad_settings(small_raw: Path, results: Path, tmp_path: Path) -> dict[str, list[object]]:
    (tmp_path / "file").write_text("x", encoding="utf-8")
    (tmp_path / "rig.toml").write_text('base = "planetary"\n[parameters]\nsun_maas = 2.0\n', encoding="utf-8")
    (tmp_path / "pipeline.toml").write_text("[frf]\nestimater = 'H1'\n", encoding="utf-8")
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "ema.h5").write_bytes((results / "ema.h5").read_bytes()[:5000])
    run: list[object] = ["run", small_raw, "--out", tmp_path / "out"]
    return {
        "unknown rig": [*run, "--rig", "planetry"],
        "misspelt parameter in a rig file": [*run, "--rig", tmp_path / "rig.toml"],
        "missing rig file": [*run, "--rig", "nowhere.toml"],
        "unknown pipeline": [*run, "--pipeline", "nowhere"],
        "misspelt key in a pipeline": [*run, "--pipeline", tmp_path / "pipeline.toml"],
        "unknown setting": [*run, "--set", "frf.estimater=H1"],
        "setting out of its choices": [*run, "--set", "frf.estimator=H7"],
        "setting without a value": [*run, "--set", "frf.estimator"],
        "raw folder that is not there": ["run", tmp_path / "nowhere"],
        "raw folder that is a file": ["run", tmp_path / "file"],
        "results folder that is a file": ["run", small_raw, "--out", tmp_path / "file"],
        "results folder under a file": ["run", small_raw, "--out", tmp_path / "file" / "out"],
        "results folder of nothing": ["compare", tmp_path],
        "half a results file": ["compare", broken],
        "init over a description": ["init", small_raw],
        "simulate over a test": ["simulate", small_raw],
        "simulate an unknown effect": [
            "simulate",
            tmp_path / "s",
            "--effect",
            "mesh_loss@sun-planet1:fraction=0.1",
        ],
    }


BAD_SETTINGS = 17


@pytest.mark.parametrize("number", range(BAD_SETTINGS))
def test_bad_settings_are_one_clear_line(
    number: int, small_raw: Path, results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = bad_settings(small_raw, results, tmp_path)
    assert len(cases) == BAD_SETTINGS
    arguments = list(cases.values())[number]
    assert_one_clear_line(*ema(capsys, *arguments))
    assert not (tmp_path / "out").exists()


def test_settings_of_a_simulated_test_are_those_that_were_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Format and seed have options of their own, which take no effect where they are left out."""
    short = ("--rig", "frame", "--set", "hits=1", "--set", "duration_s=0.2")
    given = ("--set", "seed=3", "--set", "format=csv")
    assert ema(capsys, "simulate", tmp_path / "a", *short, *given)[0] == 0
    assert ema(capsys, "simulate", tmp_path / "b", *short, "--seed", "3", "--format", "csv")[0] == 0
    a, b = (sorted((tmp_path / name).glob("*.csv")) for name in "ab")
    assert len(a) == 3
    assert [path.read_bytes() for path in a] == [path.read_bytes() for path in b]
    code, _, err = ema(capsys, "simulate", tmp_path / "c", *short, "--set", "sensors=x")
    assert code == 1
    assert "unknown key 'sensors'" in err


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            ("-e", "mass@storey1"),
            "mass@storey1 has mass = 0.05 kg by default; to choose: --effect mass@storey1:mass=VALUE",
        ),
        (
            ("-e", "out_of_tolerance@storey1_stiffness"),
            "out_of_tolerance@storey1_stiffness has relative_change = 0.3 by default; "
            "to choose: --effect out_of_tolerance@storey1_stiffness:relative_change=VALUE",
        ),
        (("-e", " mass @ storey1:mass=0.02"), ""),
        (("-e", "mass@storey1", "--value", "mass@storey1.mass=0.02"), ""),
    ],
)
def test_sizes_of_effects_that_were_not_given_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: tuple[str, ...], said: str
) -> None:
    short = ("--rig", "frame", "--set", "hits=1", "--set", "duration_s=0.2")
    code, out, err = ema(capsys, "simulate", tmp_path / "raw", *short, *given)
    assert code == 0, err
    assert out.replace("\n", " ").partition("truth.json ")[2].strip() == said


def test_an_effect_is_found_again_however_it_was_typed(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    assert "which has no added effects" in ema(capsys, "remove", out, "sensor_mass@all")[2]
    assert ema(capsys, "add", out, " sensor_mass @ all")[0] == 0
    code, _, err = ema(capsys, "add", out, "sensor_mass@all")
    assert code == 1
    assert "is in the model already" in err
    assert ema(capsys, "remove", out, "sensor_mass@all")[0] == 0


def test_every_setting_is_listed_with_its_default_its_values_and_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, out, _ = ema(capsys, "settings", "--json")
    listed = {s["name"]: s for s in json.loads(out)["settings"]}
    assert code == 0
    assert listed["frf.estimator"] | {"description": ""} == {
        "name": "frf.estimator",
        "default": "H1",
        "values": "H1 | H2 | Hv",
        "description": "",
    }
    assert listed["frf.reciprocity"]["values"] == "number > 0"
    assert listed["frf.block_samples"]["values"] == "whole number ≥ 64 | not set"
    assert [name for name, s in listed.items() if not s["description"]] == []
    code, out, _ = ema(capsys, "settings", "correlate.pairing")
    assert code == 0
    assert "correlate.pairing.least_mac = 0.4" in out
    assert "frf." not in out
    code, out, err = ema(capsys, "settings", "correlat")
    assert (code, out) == (0, ema(capsys, "settings", "correlate")[1])
    code, out, err = ema(capsys, "settings", "modla")
    assert code == 1
    assert "did you mean 'modal'" in err


def test_settings_of_a_simulated_test_are_listed_as_simulate_takes_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, out, _ = ema(capsys, "settings", "simulate", "--json")
    listed = {s["name"]: s for s in json.loads(out)["settings"]}
    assert code == 0
    assert {"hits", "contact_s", "part_scatter", "rig_seed"} <= listed.keys()
    assert listed["hits"]["default"] == 2
    assert [name for name, s in listed.items() if not s["description"]] == []
    assert "ema settings simulate" in " ".join(ema(capsys, "settings")[1].split())


def test_check_fits_80_columns_with_units_and_clauses_and_fails_where_a_point_has_no_good_hit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    test = {"hits": 2, "double_hits": ("m3.x#1", "m3.x#2", "m1.x#1")}
    raw = write_bench(tmp_path, **test)
    code, out, err = ema(capsys, "check", raw)
    assert max(map(len, out.splitlines())) <= 80
    assert len([line for line in out.splitlines() if ".h5" in line and "FAIL" in line]) == 3
    assert re.search(r"m1\.x +\d+ N +\d+\.?\d* % +\d+ Hz", out)
    assert "2.5 %" in out
    assert re.search(r"^ +force level +≥ \d+ × +\d+ × ", out, re.MULTILINE)
    assert re.search(r"^ +response decay +≤ [\d.]+ % ", out, re.MULTILINE)
    assert "ISO 7626-5" in out
    assert code == 1
    assert err.count("\n") == 1
    assert "no good hit on m3.x" in err
    listed = ema(capsys, "check", raw, "--json")
    assert listed[0] == 1
    assert {hit["force_unit"] for hit in json.loads(listed[1])["default"]} == {"N"}


def test_check_tells_what_loops_hold_and_what_is_wrong_with_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_sine_tests(tmp_path, PRINTED, frequencies_hz=(10.0,), amplitudes_m=(1e-3, 2e-3))
    code, out, err = ema(capsys, "check", tmp_path)
    assert (code, err) == (0, "")
    first, second = out.splitlines()
    found = re.fullmatch(
        r"10Hz_1mm\.csv: (\d+) cycles at 10 Hz, amplitude 0\.001 m, force up to (\S+) N, (\S+) ± \S+ J lost per cycle",
        first,
    )
    assert found
    assert all(float(number) > 0 for number in found.groups())
    assert "amplitude 0.002 m" in second
    table = tmp_path / "10Hz_1mm.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:40]) + "\n")
    code, out, err = ema(capsys, "check", tmp_path)
    assert code == 1
    assert err.count("\n") == 1
    assert "10Hz_1mm.csv" in err
    assert "hammer" not in err


def test_init_takes_the_struck_node_and_direction_from_universal_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = np.arange(1024) / 1024.0
    for number, (node, direction) in enumerate(((7, 3), (9, -1))):
        file = pyuff.UFF(str(tmp_path / f"run{number}.uff"))
        for name, own, way in (("hammer", node, direction), ("a", 7, 3), ("b", 8, 1)):
            data = (
                np.sin(40 * own * time) if name != "hammer" else np.where(abs(time - 0.1) < 0.002, 1.0, 0.0)
            )
            places = {"rsp_node": own, "rsp_dir": way, "ref_node": node, "ref_dir": direction}
            file.write_sets(
                {
                    "type": 58,
                    "func_type": 1,
                    **places,
                    "data": data,
                    "x": time,
                    "id1": name,
                    "binary": 0,
                    "abscissa_spacing": 1,
                    "rsp_ent_name": "NONE",
                    "ref_ent_name": "NONE",
                    "abscissa_spec_data_type": 17,
                    "ordinate_spec_data_type": 0,
                    "orddenom_spec_data_type": 0,
                },
                mode="add",
            )
    code, _, err = ema(capsys, "init", tmp_path)
    assert code == 0, err
    text = (tmp_path / "test.toml").read_text(encoding="utf-8")
    assert re.findall(r'impact = "(.*?)"(.*)', text) == [("7.z", ""), ("-9.x", "")]
    assert 'dof = "7.z"' in text


@pytest.mark.parametrize(
    ("stage", "stages"),
    [
        ("ingest", 'stages=["ingest", "hits", "frf", "modal"]'),
        pytest.param("modal", 'stages=["ingest", "hits", "frf", "modal", "ladder"]', marks=pytest.mark.slow),
    ],
    ids=["ingest", "modal"],
)
def test_ctrl_c_ends_within_a_second_with_one_line_that_says_how_to_go_on(
    small_raw: Path, tmp_path: Path, stage: str, stages: str
) -> None:
    out = tmp_path / "out"
    command = [*RUN, str(small_raw), "--rig", "planetary", "--set", stages, "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        assert run.stderr is not None
        line = run.stderr.readline()
        while stage not in line:  # the line of a stage is written once it is done
            line = run.stderr.readline()
            assert line, "the run ended before it was interrupted"
        os.killpg(run.pid, signal.SIGINT)
        before = time.monotonic()
        rest = run.stderr.read()
        code = run.wait(10)
        assert time.monotonic() - before < 1.5  # one second, and room for a busy machine
    assert code == 130
    (told,) = [text for text in rest.splitlines() if text.startswith("ema:")]
    assert told.startswith("ema: interrupted; finished stages are kept, go on with: ema run")
    done = subprocess.run([*command, "--verbose"], capture_output=True, text=True, check=True)
    assert stage not in done.stdout.partition("Computed: ")[2].split(", ")[0]


@pytest.mark.parametrize(
    ("ending", "code", "told"),
    [
        ("", 130, "ema: interrupted; nothing was changed"),
        ("end_by_ctrl_c(lambda: 'stopped')", 0, "ema: stopped"),
    ],
)
def test_what_does_not_end_in_time_is_ended_with_the_code_of_its_command(
    ending: str, code: int, told: str
) -> None:
    """A page ends well by Ctrl-C, on a busy machine as well."""
    stuck = f"""
import os, signal, time
from ema_pipeline.commands.interrupts import answer_ctrl_c, end_by_ctrl_c
answer_ctrl_c("ema")
{ending}
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    time.sleep(20)
"""
    done = subprocess.run([sys.executable, "-c", stuck], capture_output=True, text=True, timeout=15)
    assert done.returncode == code
    assert done.stderr.strip() == told


def test_a_stage_of_another_kind_of_test_is_refused(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing computed and nothing printed would look like an answer."""
    table, out = results / "modes.csv", tmp_path / "out"
    options = ("--rig", "planetary", "--set", 'stages=["modal"]', "--quiet")
    assert ema(capsys, "run", "--modes", table, "--out", out, *options)[0] == 0
    for verb in ("hits", "levels"):
        code, text, err = ema(capsys, verb, out)
        assert (code, text) == (1, "")
        assert f"tables of modes have no stage '{verb}'; theirs are correlate" in err


def test_a_setting_with_alternatives_says_all_of_them(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = ema(capsys, "frf", results, "--set", "frf.exponential_window=x")
    assert code == 1
    assert (
        "frf.exponential_window = 'x': Input should be 'none' or 'auto' or Input should be a valid number"
        in err
    )


def test_what_loops_hold_is_printed_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_sine_tests(tmp_path, PRINTED, frequencies_hz=(10.0,), amplitudes_m=(1e-3,))
    code, out, _ = ema(capsys, "check", tmp_path, "--json")
    assert code == 0
    assert json.loads(out)["records"][0].startswith("10Hz_1mm.csv: ")


def test_results_are_no_records_to_describe(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    shutil.copy(results / "ema.h5", tmp_path / "out")
    code, _, err = ema(capsys, "init", tmp_path / "out")
    assert code == 1
    assert "no record files here" in err
