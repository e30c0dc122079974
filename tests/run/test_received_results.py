"""A results folder that somebody else has sent: nothing in it runs, leads elsewhere or steers the terminal."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ema_pipeline.cli import app
from ema_pipeline.describe import describe_modes
from ema_pipeline.errors import EmaError
from ema_pipeline.files import replace_file
from ema_pipeline.job import adding, change_effects, changed_effects, run_on, run_raw
from ema_pipeline.pipeline import run_stages
from ema_pipeline.results_folder import LOCK_FILE
from ema_pipeline.run.opening import existing_run, load_info, save_info
from ema_pipeline.run.types import Progress, Run
from ema_pipeline.stages import fit
from ema_pipeline.stages.results import load_results
from ema_pipeline.store import ALL, Store

EFFECT = """
from pathlib import Path
Path({marker!r}).touch()
from ema_pipeline.effects.spring import EFFECT as SHIPPED
from dataclasses import replace
EFFECT = replace(SHIPPED, id="film")
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a small table of modes."""
    folder = tmp_path_factory.mktemp("modes")
    table = folder / "case1.toml"
    table.write_text("schema = 1\n[no_ring]\nfrequency_hz = [62.5, 85.7, 134.0]\n", encoding="utf-8")
    out = folder / "out"
    command = ["run", "--modes", str(table), "--rig", "planetary", "--out", str(out), "--set"]
    done = CliRunner().invoke(app, [*command, 'stages=["modal", "ladder", "fit", "correlate"]'])
    assert done.exit_code == 0, done.output
    return out


def received(results: Path, folder: Path, **changes: object) -> Path:
    """A copy of the results whose description says something else."""
    out = folder / "received"
    shutil.copytree(results, out)
    store = Store(out)
    info = load_info(store)
    assert info is not None
    save_info(store, dataclasses.replace(info, **changes))
    return out


def contents(out: Path) -> dict[str, bytes]:
    """What every file of a results folder holds, but for that of its lock."""
    files = (path for path in out.rglob("*") if path.is_file() and path.name != LOCK_FILE)
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def with_effect_file(results: Path, folder: Path, file: Path) -> Path:
    """A copy of the results that remembers a Python file, and has its effect in the model."""
    info = load_info(Store(results))
    assert info is not None
    pipeline = json.loads(info.pipeline) | {"effect_files": [str(file)]}
    return received(results, folder, pipeline=json.dumps(pipeline), effects=("film@sun.y",))


@pytest.mark.parametrize(
    "verb", ["ladder", "compare", "fit", "diagnose", "report", "export", "add", "remove"]
)
def test_the_code_that_received_results_name_does_not_run(results: Path, tmp_path: Path, verb: str) -> None:
    marker, file = tmp_path / "it_ran", tmp_path / "film.py"
    file.write_text(EFFECT.format(marker=str(marker)), encoding="utf-8")
    out = with_effect_file(results, tmp_path, file)
    more = ["film@sun.y"] if verb in ("add", "remove") else []
    done = CliRunner().invoke(app, [verb, str(out), *more])
    assert not marker.exists()
    if verb != "export":  # what was measured is exported without a model
        assert isinstance(done.exception, EmaError)
        assert f"--effect-file {file}" in str(done.exception)


def test_a_file_that_is_named_in_the_call_runs(results: Path, tmp_path: Path) -> None:
    marker, file = tmp_path / "it_ran", tmp_path / "film.py"
    file.write_text(EFFECT.format(marker=str(marker)), encoding="utf-8")
    # the results remember the path that it had on its maker's computer
    out = with_effect_file(results, tmp_path, Path("/home/maker/film.py"))
    done = CliRunner().invoke(app, ["fit", str(out), "--effect-file", str(file)])
    assert done.exit_code == 0, done.exception
    assert marker.exists()
    info = load_info(Store(out))
    assert info is not None
    assert json.loads(info.pipeline)["effect_files"] == [str(file)]
    assert list(info.effect_hashes) == [str(file)]


def test_commands_shown_name_files_that_the_user_has_named_and_no_other(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "film.py"
    file.write_text(EFFECT.format(marker=str(tmp_path / "it_ran")), encoding="utf-8")
    pipeline = json.loads(load_info(Store(results)).pipeline) | {"effect_files": [str(file)]}  # type: ignore[union-attr]
    out = received(results, tmp_path, pipeline=json.dumps(pipeline))
    assert load_results(existing_run(out)).effect_files == ()
    assert load_results(existing_run(out, [str(file)])).effect_files == (str(file),)
    monkeypatch.chdir(tmp_path)
    assert load_results(existing_run(out, ["film.py"])).effect_files == ("film.py",)


def test_a_pipeline_file_cannot_make_code_run(tmp_path: Path) -> None:
    marker, file = tmp_path / "it_ran", tmp_path / "film.py"
    file.write_text(EFFECT.format(marker=str(marker)), encoding="utf-8")
    pipeline = tmp_path / "pipeline.toml"
    pipeline.write_text(f'stages = ["modal", "diagnose"]\neffect_files = ["{file}"]\n', encoding="utf-8")
    table = tmp_path / "case1.toml"
    table.write_text("schema = 1\n[no_ring]\nfrequency_hz = [62.5, 85.7, 134.0]\n", encoding="utf-8")
    command = ["run", "--modes", str(table), "--rig", "planetary", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*command, "--pipeline", str(pipeline)])
    assert not marker.exists()
    assert f"--effect-file {file}" in str(done.exception)


def test_an_effect_file_that_ends_the_program_is_one_clear_line(tmp_path: Path) -> None:
    file = tmp_path / "film.py"
    file.write_text("import sys\nsys.exit(0)\n", encoding="utf-8")
    out = tmp_path / "raw"
    done = CliRunner().invoke(
        app, ["simulate", str(out), "--effect", "film@sun.y:stiffness=1", "--effect-file", str(file)]
    )
    assert isinstance(done.exception, EmaError)
    assert "does not run: SystemExit" in str(done.exception)


@pytest.mark.parametrize("verb", ["fit", "diagnose", "add", "exclude"])
def test_an_effect_file_that_is_refused_is_not_remembered(results: Path, tmp_path: Path, verb: str) -> None:
    file = tmp_path / "film.py"
    file.write_text("x = 1\n", encoding="utf-8")
    out = received(results, tmp_path)
    more = {"add": ["spring@sun.y"], "exclude": ["--mode", "62.5"]}.get(verb, [])
    before = load_info(Store(out))
    done = CliRunner().invoke(app, [verb, str(out), *more, "--effect-file", str(file)])
    assert "defines no EFFECT" in str(done.exception)
    assert load_info(Store(out)) == before
    done = CliRunner().invoke(app, ["fit", str(out)])
    assert done.exit_code == 0, done.exception


@pytest.mark.parametrize("first", [(), ("spring@sun.y",)])
def test_effects_are_taken_back_where_the_model_with_them_cannot_be_fitted(
    results: Path, tmp_path: Path, first: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = received(results, tmp_path)
    if first:
        with changed_effects(out, adding(first)) as run:
            run_stages(run, ["fit"])
    before, ladder = load_info(Store(out)), CliRunner().invoke(app, ["ladder", str(out)]).output
    file = tmp_path / "film.py"
    file.write_text(EFFECT.format(marker=str(tmp_path / "it_ran")), encoding="utf-8")
    work = fit.work

    def fails(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
        if "film@sun.x" in run.info.effects:
            raise EmaError("the model's stiffness is negative")
        return work(run, configuration, progress)

    monkeypatch.setattr("ema_pipeline.stages.fit.work", fails)
    done = CliRunner().invoke(app, ["add", str(out), "film@sun.x", "--effect-file", str(file)])
    assert "stiffness is negative" in str(done.exception)
    assert load_info(Store(out)) == before
    assert CliRunner().invoke(app, ["ladder", str(out)]).output == ladder
    again = CliRunner().invoke(app, ["fit", str(out)])
    assert again.exit_code == 0, again.exception


@pytest.mark.parametrize("verb", ["add", "remove"])
def test_a_change_of_effects_that_fails_leaves_diagnosis_results_and_report_as_they_were(
    results: Path, tmp_path: Path, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, effect = received(results, tmp_path), "spring@sun.y"
    if verb == "remove":
        done = CliRunner().invoke(app, ["add", str(out), effect])
        assert done.exit_code == 0, done.exception
    # made with an effect that the changed model does not have: the change drops it
    Store(out).save(
        "diagnose", ALL, "key", "{}", 0.1, on_top_of=(effect if verb == "remove" else "mass@sun",)
    )
    before = contents(out)

    def fails(*_: object) -> None:
        assert not Store(out).key("diagnose")
        replace_file(out / "summary.json", "of a model that is taken back")
        raise EmaError("the report cannot be drawn")

    monkeypatch.setattr("ema_pipeline.stages.report.work", fails)
    done = CliRunner().invoke(app, [verb, str(out), effect])
    assert "cannot be drawn" in str(done.exception)
    assert contents(out) == before


@pytest.mark.parametrize(("stage", "kept"), [("ladder", False), ("fit", True)])
def test_an_interrupted_change_of_effects_is_kept_once_its_ladder_stands(
    results: Path, tmp_path: Path, stage: str, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = received(results, tmp_path)
    before = contents(out)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"ema_pipeline.stages.{stage}.work", interrupted)
    with pytest.raises(KeyboardInterrupt):
        change_effects(out, adding(["spring@sun.y"]))
    assert (contents(out) != before) is kept
    assert existing_run(out).info.effects == (("spring@sun.y",) if kept else ())


@pytest.mark.parametrize("stopped_by", [EmaError("it does not work"), KeyboardInterrupt()])
def test_settings_are_kept_unless_a_stage_fails_with_them(
    results: Path, tmp_path: Path, stopped_by: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise stopped_by

    out = received(results, tmp_path)
    before = load_info(Store(out))
    monkeypatch.setattr("ema_pipeline.stages.fit.work", fails)
    with pytest.raises(type(stopped_by)):
        run_on(out, ["fit"], ["fit.frequency_std_assumed=0.02"])
    assert (load_info(Store(out)) == before) is isinstance(stopped_by, EmaError)


def test_settings_of_a_run_that_fails_are_taken_back(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise EmaError("it does not work")

    out = received(results, tmp_path)
    before = load_info(Store(out))
    assert before is not None
    monkeypatch.setattr("ema_pipeline.stages.fit.work", fails)
    with pytest.raises(EmaError, match="does not work"):
        run_raw(
            Path(before.raw),
            "planetary",
            out,
            overrides=['stages=["modal", "ladder", "fit"]', "fit.frequency_std_assumed=0.02"],
            describe_source=describe_modes,
        )
    assert load_info(Store(out)) == before


def test_a_change_whose_process_was_killed_is_taken_back_by_the_next_one(
    results: Path, tmp_path: Path
) -> None:
    """Description, results and report belong together again, and the change can be repeated."""
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    before = contents(out)
    child = os.fork()
    if child == 0:
        with changed_effects(
            out, adding(["sensor_mass@all"])
        ):  # description and ladder are those of the change
            (out / "report.html").write_text("new", encoding="utf-8")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert contents(out) != before
    with Store(out).lock():
        assert contents(out) == before
    assert change_effects(out, adding(["sensor_mass@all"])).info.effects == ("sensor_mass@all",)


def test_a_change_builds_on_what_another_process_has_changed(results: Path, tmp_path: Path) -> None:
    """What is changed is read once the folder is locked: nothing of another change is lost."""
    out = tmp_path / "copy"
    shutil.copytree(results, out)
    lock = Store.lock

    def late(store: Store) -> contextlib.AbstractContextManager[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Store, "lock", lock)
            change_effects(out, adding(["sensor_mass@all"]))
        return lock(store)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "lock", late)
        run = change_effects(out, adding(["shaft_torsion@sun"]))
    assert run.info.effects == ("sensor_mass@all", "shaft_torsion@sun")
