"""Kinds of tests: the stages that each goes through, and that nothing else in the program tells them apart."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import get_args

import pytest
from continuous_cases import write_oscillator
from typer.testing import CliRunner

import ema_pipeline
from ema_pipeline.cli import app
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.kinds import KINDS, kind_of, require_judge, stages_of
from ema_pipeline.loops.simulate import write_sine_tests
from ema_pipeline.rigs import load_rig
from ema_pipeline.run.opening import existing_run
from ema_pipeline.run.settings import STAGES

PACKAGE = Path(ema_pipeline.__file__).parent

pytestmark = pytest.mark.usefixtures("without_figures")


def ema(*words: str | Path) -> None:
    found = CliRunner().invoke(app, [str(w) for w in words])
    assert found.exit_code == 0, found.output


def stored(out: Path) -> set[str]:
    return {stage for stage, _ in existing_run(out).store.provenance()}


def test_every_kind_that_a_description_can_state_is_known() -> None:
    stated = get_args(TestDescription.model_fields["kind"].annotation)
    assert {*stated, "modes"} == set(KINDS)
    assert all(kind.name == name for name, kind in KINDS.items())


@pytest.mark.parametrize("name", list(KINDS))
def test_what_a_kind_measures_stands_in_the_order_of_the_stages(name: str) -> None:
    measures = KINDS[name].measures
    assert [STAGES.index(stage) for stage in measures] == sorted(STAGES.index(stage) for stage in measures)


def test_only_kinds_ask_which_kind_a_run_is_of() -> None:
    asks = re.compile(r"info\.kind\s*(==|!=|in\b)")
    found = [p for p in PACKAGE.rglob("*.py") if asks.search(p.read_text(encoding="utf-8"))]
    assert {p.parent.name for p in found} <= {"kinds"}


def test_results_of_a_test_of_another_kind_do_not_stay_in_the_folder(tmp_path: Path) -> None:
    raw, loops, out = tmp_path / "raw", tmp_path / "loops", tmp_path / "out"
    write_oscillator(raw, lambda x, v: 0.0)
    write_sine_tests(loops, {"stiffness": 9e4, "viscous_damping": 40.0}, (10.0,), (1e-3, 2e-3))
    ema("run", raw, "--out", out, "--set", 'stages=["ingest", "frf", "modal", "report"]', "--quiet")
    assert stored(out) == {"ingest", "frf", "modal", "report"}
    run = existing_run(out)
    assert stages_of(run) == {"ingest", "frf", "modal", "diagnose", "ladder", "report"}
    unknown = dataclasses.replace(run.info, kind="acoustic")
    with pytest.raises(EmaError, match="kind 'acoustic', which this version of ema does not know"):
        kind_of(unknown)

    # Several configurations without a rig have no model, so that nothing judges it.
    several = dataclasses.replace(
        run, info=dataclasses.replace(run.info, configurations=("one", "two")), built_rig=None
    )
    assert stages_of(several) == {"ingest", "frf", "modal", "report"}
    with pytest.raises(EmaError, match="'diagnose' needs a model; run again with --rig"):
        require_judge(several, "diagnose")
    with_rig = dataclasses.replace(several, built_rig=load_rig("frame"))
    assert stages_of(with_rig) == set(STAGES) - {"hits", "levels", "loops"}

    ema("run", loops, "--out", out, "--set", 'stages=["loops", "report"]', "--quiet")
    assert stored(out) == {"loops", "report"}
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert "modes" not in summary["configurations"]["default"]
