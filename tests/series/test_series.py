"""A series of tests from raw folders to the table, through the command line, killed and resumed."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from bench import ema, facts_of_series, write_bench
from typer.testing import CliRunner

from ema_pipeline.cli import app
from ema_pipeline.errors import EmaError
from ema_pipeline.series.database import SeriesDatabase
from ema_pipeline.series.engine import LOST, in_processes
from ema_pipeline.series.export import export_series
from ema_pipeline.series.find import find_tests
from ema_pipeline.series.one_test import Task
from ema_pipeline.series.rows import TestRow, failed_row
from ema_pipeline.series.run import run_series

pytestmark = pytest.mark.usefixtures("without_figures")


def _simulate(root: Path, names: list[str], **settings: object) -> Path:
    for i, name in enumerate(names):
        write_bench(root, f"tree/{name}", impacts=["m1.x"], hits=2, seed=50 + i, **settings)
    return root / "tree"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("series")
    tree = _simulate(root, ["lot1/a1", "lot1/a2", "b1"])
    text = (tree / "b1" / "test.toml").read_text(encoding="utf-8")
    text = text.replace("schema = 1\n", 'schema = 1\nserial_number = "B 1"\ndate = 2025-03-31\n')
    (tree / "b1" / "test.toml").write_text(text, encoding="utf-8")
    (tree / "broken").mkdir()
    (tree / "broken" / "test.toml").write_text("channels = 3\n", encoding="utf-8")
    return root


@pytest.fixture(scope="module")
def whole(root: Path) -> tuple[Path, str]:
    """The series of all four tests in two processes, and what was said."""
    out = root / "S"
    command = ["series", "run", root / "tree", "--rig", root / "bench.toml", "--out", out, "--jobs", 2]
    done = CliRunner().invoke(app, [*map(str, command), "--parquet"])
    assert done.exit_code == 0, done.output
    return out, done.stdout


def test_series_from_raw_folders_to_a_table(
    root: Path, whole: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Right rows, one reason, unchanged tests skipped, a changed one run again."""
    out, said = whole
    command = ("series", "run", root / "tree", "--rig", root / "bench.toml", "--out", out, "--jobs", 2)
    assert "4 tests: 4 run, 0 unchanged, 1 without results" in said
    assert "broken" in said
    tests = facts_of_series(out)["tests"].set_index("test")
    assert list(tests.index) == ["b1", "broken", "lot1/a1", "lot1/a2"]
    assert list(tests["state"]) == ["ok", "failed", "ok", "ok"]
    assert "channels" in tests.loc["broken", "reason"]
    assert tests.loc["b1", "serial_number"] == "B 1"
    assert tests.loc["b1", "date"] == "2025-03-31"
    assert tests.loc["b1", "hits_used"] == 2

    modes = facts_of_series(out)["modes"]
    own = json.loads((out / "tests/lot1/a1/summary.json").read_text())["configurations"]["default"]["modes"]
    mine = modes[modes["test"] == "lot1/a1"]
    assert list(mine["frequency_hz"]) == pytest.approx([m["frequency_hz"] for m in own])
    assert list(mine["model_mode"]) == [1, 2, 3]
    wide = pd.read_parquet(out / "tests.parquet").set_index("test")
    assert wide.loc["lot1/a1", "default.mode2.frequency_hz"] == pytest.approx(own[1]["frequency_hz"])
    assert list(pd.read_csv(out / "tests.csv").columns) == ["test", *wide.columns]

    before = facts_of_series(out)
    code, said, _ = ema(capsys, *command)
    assert "4 tests: 0 run, 4 unchanged, 1 without results" in said
    (root / "tree/lot1/a2/test.toml").touch()
    code, said, _ = ema(capsys, *command, "--json")
    assert json.loads(said)["computed"] == 1
    after = facts_of_series(out)
    for name in ("modes", "parameters"):
        pd.testing.assert_frame_equal(before[name], after[name])

    code, _, err = ema(capsys, "series", "run", root, "--out", out)
    assert code == 1
    assert "holds the series of" in err


def test_a_folder_without_tests_is_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, exit code 1."""
    assert ema(capsys, "series", "run", tmp_path, "--out", tmp_path / "S")[0] == 1
    code, _, err = ema(capsys, "series", "judge", tmp_path)
    assert code == 1
    assert "series.db" in err


def test_campaigns_are_one_test(tmp_path: Path) -> None:
    """Sub-folders with different configurations belong together, tests of one configuration do not."""
    for name, configuration in (("u1/a", "x"), ("u1/b", "y"), ("u2/a", "x"), ("u2/b", "x"), ("u3", None)):
        (tmp_path / name).mkdir(parents=True)
        line = f'configuration = "{configuration}"' if configuration else ""
        (tmp_path / name / "test.toml").write_text(line, encoding="utf-8")
    for name in ("u4/soft", "u4/hard"):
        (tmp_path / name).mkdir(parents=True)
        part = f'part = "{Path(name).name}"\nconfiguration = "same"\n'
        (tmp_path / name / "test.toml").write_text(part, encoding="utf-8")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "ema.h5").touch()
    (tmp_path / "results" / "test.toml").touch()
    found = [t.name for t in find_tests(tmp_path, tmp_path / "S")]
    assert found == ["u1", "u2/a", "u2/b", "u3", "u4"]


def _sometimes_dies(task: Task) -> TestRow:
    if task.name == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return failed_row(task.name, task.raw, task.key, f"seen by {os.getpid()}")


def test_a_task_that_kills_its_process_is_one_row() -> None:
    """All others have their own rows, once each."""
    tasks = [Task(name, "", "", "k") for name in ("a", "b", "bad", "c", "d", "e")]
    rows = list(in_processes(tasks, 2, _sometimes_dies))
    assert sorted(r.name for r in rows) == ["a", "b", "bad", "c", "d", "e"]
    bad = next(r for r in rows if r.name == "bad")
    assert (bad.test["state"], bad.test["reason"], bad.test["key"]) == ("lost", LOST, "")
    assert all(str(r.test["reason"]).startswith("seen by") for r in rows if r.name != "bad")


def _lost(task: Task) -> TestRow:
    return failed_row(task.name, task.raw, "", LOST, "lost")


def test_a_series_of_which_all_tests_are_lost_ends(tmp_path: Path) -> None:
    """Twenty tests without a cost: nothing is divided by it."""
    for i in range(20):
        (tmp_path / "tree" / f"t{i:02d}").mkdir(parents=True)
        (tmp_path / "tree" / f"t{i:02d}" / "test.toml").write_text("schema = 1\n", encoding="utf-8")
    done = run_series(tmp_path / "tree", tmp_path / "S", jobs=2, work=_lost)
    assert (done.computed, done.failed) == (20, 20)
    assert done.growth != done.growth


@pytest.mark.slow
def test_killed_and_resumed_gives_the_same_table(root: Path, whole: tuple[Path, str], tmp_path: Path) -> None:
    """The whole process group is killed after the first test is in the table."""
    resumed = tmp_path / "resumed"
    command = [sys.executable, "-m", "ema_pipeline.cli", "series", "run", str(root / "tree"), "-j", "1", "-q"]
    command += ["--rig", str(root / "bench.toml"), "--out"]
    killed = subprocess.Popen([*command, str(resumed)], start_new_session=True)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and killed.poll() is None:
        if (resumed / "series.db").is_file():
            with sqlite3.connect(resumed / "series.db") as connection:
                try:
                    done = connection.execute("SELECT count(*) FROM tests").fetchone()[0]
                except sqlite3.OperationalError:
                    done = 0
            if done:
                break
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    database = SeriesDatabase.existing(resumed)
    assert 0 < len(database.table("tests")) < 4
    database.close()
    subprocess.run([*command, str(resumed)], check=True)
    one, other = facts_of_series(whole[0]), facts_of_series(resumed)
    for name in one:
        pd.testing.assert_frame_equal(one[name], other[name])


@pytest.mark.slow
def test_dask_cluster_survives_a_lost_worker(root: Path, tmp_path: Path) -> None:
    """Scheduler and workers are processes of their own; one worker is killed midway; nothing lost, nothing double."""
    pytest.importorskip("distributed")
    tree = _simulate(tmp_path, [f"u{i}" for i in range(8)])
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    file = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen(
        [*dask, "--port", "0", "--no-dashboard", "--scheduler-file", str(file)], stderr=subprocess.DEVNULL
    )
    workers: list[subprocess.Popen[bytes]] = []
    try:
        while not file.is_file() or not file.read_text():
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        for _ in range(2):
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", address]
            options = ["--nthreads", "1", "--no-dashboard", "--no-nanny"]
            workers.append(subprocess.Popen([*worker, *options], stderr=subprocess.DEVNULL))
        out = tmp_path / "S"
        command = [
            sys.executable,
            "-m",
            "ema_pipeline.cli",
            "series",
            "run",
            str(tree),
            "-q",
            "--out",
            str(out),
        ]
        driver = subprocess.Popen([*command, "--rig", str(tmp_path / "bench.toml"), "--scheduler", address])
        while not (out / "tests").is_dir() or len(list((out / "tests").glob("*/summary.json"))) < 2:
            assert driver.poll() is None
            time.sleep(0.1)
        workers[0].kill()
        assert driver.wait(timeout=300) == 0
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()
    tests = facts_of_series(out)["tests"]
    assert list(tests["test"]) == [f"u{i}" for i in range(8)]
    assert set(tests["state"]) == {"ok"}
    assert len(facts_of_series(out)["modes"]) == 8 * 3


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9"])
def test_no_scheduler_is_one_line(root: Path, tmp_path: Path, address: str) -> None:
    """Dask is there, the scheduler is not; nothing is said at the end of the program either."""
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "ema_pipeline.cli", "series", "run", str(root / "tree"), "--out"]
    ended = subprocess.run(
        [*command, str(tmp_path / "S"), "--scheduler", address], capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"ema: --scheduler {address}: no Dask scheduler answers there")
    assert len(ended.stderr.splitlines()) == 1


def test_own_effects_run_where_they_are_named_and_nowhere_else(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The user's effect competes in every test; without the option its code does not run, whatever S remembers."""
    marker, file, out = tmp_path / "ran", tmp_path / "film.py", tmp_path / "S"
    file.write_text(
        f"from pathlib import Path\nPath({str(marker)!r}).touch()\nfrom dataclasses import replace\n"
        "from ema_pipeline.effects.spring import EFFECT as SHIPPED\nEFFECT = replace(SHIPPED, id='film')\n",
        encoding="utf-8",
    )
    command = (
        "series",
        "run",
        root / "tree" / "lot1",
        "--rig",
        root / "bench.toml",
        "--out",
        out,
        "-j",
        2,
        "-q",
        "--set",
        'stages=["ingest", "hits", "frf", "modal", "ladder", "diagnose", "report"]',
        "--set",
        "diagnose.most_effects=1",
    )
    code, _, err = ema(capsys, *command, "--effect-file", file)
    assert (code, err) == (0, "")
    assert marker.exists()
    summaries = [out / "tests" / name / "summary.json" for name in ("a1", "a2")]
    assert all("film@" in s.read_text(encoding="utf-8") for s in summaries)
    assert ema(capsys, *command, "--effect-file", file, "--json")[1].count('"computed": 0')

    marker.unlink()
    assert ema(capsys, *command)[0] == 0
    assert not marker.exists()
    assert not any("film@" in s.read_text(encoding="utf-8") for s in summaries)

    file.write_text("EFFECT = 3\n", encoding="utf-8")
    code, _, err = ema(capsys, *command, "--effect-file", file)
    assert (code, err.count("\n")) == (1, 1)
    assert "film.py" in err
    code, _, err = ema(capsys, *command, "--effect-file", tmp_path / "none.py")
    assert (code, err.count("\n")) == (1, 1)
    assert "no such effect file" in err


def test_parquet_without_what_writes_it_is_one_clear_line(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(EmaError, match=r"pip install 'ema-pipeline\[parquet\]'"):
        export_series(None, tmp_path / "out", parquet=True)
    assert not (tmp_path / "out").exists()
