"""What readers see of the study of force levels."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from ema_pipeline.dof import Dof
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.sentences import flagged
from ema_pipeline.levels.types import DecayCurve, ForceLevel, LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart
from ema_pipeline.report import summary, terminal
from ema_pipeline.report.html import report_html
from ema_pipeline.report.plots import figure_specs
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.summary_files import summary as summary_json

POINT = Dof("p0", "z")
AXIS = np.arange(0, 200, 0.5)


def frf_of(frequency_hz: float) -> np.ndarray:
    w, w0 = 2 * np.pi * AXIS, 2 * np.pi * frequency_hz
    return np.asarray(-(w**2) / (w0**2 - w**2 + 0.02j * w0 * w))[None, None]


def level(force_n: float, frequency_hz: float) -> ForceLevel:
    ones = np.ones((1, 1, len(AXIS)))
    frfs = FrfSet(
        AXIS, frf_of(frequency_hz), 0.999 * ones, 1e-4 * ones, (POINT,), (POINT,), ("acceleration",), np.array([[2]]),
        "H1", 2.0, 0.0, np.array([0.05]), (1.0, 180.0), True, np.zeros(1),
    )  # fmt: skip
    return ForceLevel(force_n, (f"{force_n:g}.csv#1",), frfs)


def mode_at(frequency_hz: float) -> Mode:
    w = 2 * np.pi * frequency_hz
    return Mode(
        frequency_hz, 0.01, 0.01, 1e-4, complex(-0.01 * w, w), np.ones(1, complex), np.zeros(1), 1.0, "plscf"
    )


@pytest.fixture
def results() -> RunResults:
    none = np.zeros(0)
    chart = StabilisationChart(none.astype(int), none, none, none.astype(bool), none.astype(int))
    levels = (level(30.0, 101.2), level(300.0, 104.7))
    frfs = levels[0].frfs
    modal = ModalModel(
        (POINT,), (mode_at(103.0), mode_at(150.0)), (1.0, 180.0), True, "", (POINT,), AXIS, frfs.frf, (POINT,),
        (POINT,), chart,
    )  # fmt: skip
    both = np.array([0.0, 0.0])
    moving = ModeLevels(
        0, np.array([101.2, 104.7]), np.array([0.02, 0.03]), np.array([0.01, 0.01]), np.array([1e-4, 1e-4]),
        np.ones((2, 1)), 1e-9, 0.7, True, "hardening", np.array([0, 0]),
        np.array([0.0, 3.5]), np.array([0.0, 0.04]), both, np.array([0.0, 1e-4]),
    )  # fmt: skip
    lost = ModeLevels(
        1, np.array([np.nan, 150.0]), np.array([np.nan, 0.1]), np.array([np.nan, 0.01]), np.array([np.nan, 1e-3]),
        np.ones((2, 1)), float("nan"), float("nan"), False, "", np.array([-1, 1]),
    )  # fmt: skip
    curve = DecayCurve(
        0, "300.csv#1", POINT, np.array([1e-4, 1e-5]), np.array([104.0, 101.5]), np.array([0.1, 0.1]),
        np.array([0.01, 0.01]), np.array([1e-4, 1e-4]),
    )  # fmt: skip
    study = LevelStudy(
        levels, (POINT,), (moving, lost), (curve,), (), True, 1e-8, "The structure is not linear."
    )
    configuration = ConfigurationResults("c", frfs=frfs, modal=flagged(modal, study), levels=study)
    return RunResults("t", configurations=(configuration,))


def test_flags_say_how_far_a_mode_moves_and_which_modes_only_hard_hits_show(results: RunResults) -> None:
    modal = results.configurations[0].modal
    assert modal is not None
    assert modal.modes[0].flags == (
        "frequency rises with force: 101.20 ± 0.02 → 104.70 ± 0.03 Hz from 30 to 300 N",
    )
    assert "not found in hits softer than 300 N" in modal.modes[1].flags[0]


def test_only_what_leaves_no_doubt_is_called_clear(results: RunResults) -> None:
    study = results.configurations[0].levels
    assert study is not None
    assert study.clearly_level_dependent
    assert not replace(study, p_value=1e-3, modes=()).clearly_level_dependent
    assert not replace(study, level_dependent=False).clearly_level_dependent


def test_the_summary_file_holds_every_mode_at_every_level(results: RunResults) -> None:
    content = summary_json(results)["configurations"]["c"]
    assert content["levels"]["forces_n"] == [30.0, 300.0]
    assert content["levels"]["level_dependent"] is True
    assert content["levels"]["modes"][0]["frequency_hz"] == [101.2, 104.7]
    assert "frequency rises" in content["modes"][0]["flags"][0]


def test_the_report_has_a_section_where_there_is_something_to_say(results: RunResults) -> None:
    names = [s.name for s in figure_specs(results)]
    assert "c_levels" in names
    assert "c_levels_mode_01" in names
    page = report_html(results)
    assert "Does it depend on how hard you hit?" in page
    assert "101.200 ± 0.020" in page
    assert any("not linear" in line for line in summary.findings(results))


def test_the_report_keeps_quiet_about_one_level_that_shows_nothing(results: RunResults) -> None:
    study = results.configurations[0].levels
    assert study is not None
    quiet = replace(
        study, levels=study.levels[:1], level_dependent=False, modes=(), summary="cannot be known"
    )
    silent = replace(results, configurations=(replace(results.configurations[0], levels=quiet),))
    assert not any("levels" in s.name for s in figure_specs(silent))
    assert "how hard you hit" not in report_html(silent)
    assert not any("cannot be known" in line for line in summary.findings(silent))


def test_the_terminal_shows_the_levels_in_eighty_columns(results: RunResults) -> None:
    found = results.configurations[0]
    assert found.levels is not None
    assert found.modal is not None
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(terminal.levels_tables(found.levels, found.modal, "c"))
    lines = console.export_text().splitlines()
    assert max(len(line) for line in lines) <= 80
    assert any(
        line.startswith("!") and "101.200 ± 0.020" in line and "104.700 ± 0.030" in line for line in lines
    )
