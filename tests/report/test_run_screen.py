"""What `ema run` tells on one screen, and that one number is the same wherever it stands."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest
from bench import ema, write_bench
from rich.console import Console

from ema_pipeline.commands.screen import program
from ema_pipeline.report import run_screen
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.report.run_screen import SCREEN_LINES
from ema_pipeline.report.tables import Row, Table

if TYPE_CHECKING:
    from ema_pipeline.modal.types import ModalModel

pytestmark = pytest.mark.usefixtures("without_figures")

NO_FIGURES = ("--set", "report.plots=false")


@pytest.fixture(scope="module")
def crack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A test of the user's own rig with a hidden spring to ground."""
    return write_bench(
        tmp_path_factory.mktemp("crack"), effects=["spring@m2:stiffness=1.5e5"], imperfection="good"
    )


@pytest.mark.slow
def test_a_run_is_told_in_fifteen_lines_with_one_story_through_add_and_remove(
    crack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code, text, err = ema(capsys, "run", crack, "--out", out, *NO_FIGURES)
    assert code == 0, err
    lines = text.splitlines()
    assert len(lines) <= SCREEN_LINES
    assert max(map(len, (line for line in lines if not line.startswith(("Next:", "Report:"))))) <= 80
    assert lines[0].startswith("Missing: spring at m2")
    flowing = " ".join(text.split())
    found = re.search(r"error ([\d.]+) → ([\d.]+)", flowing)
    assert found is not None
    before, after = found.groups()
    assert re.search(r"mode +frequency, Hz +damping, % +model, Hz +difference, % +MAC", text)
    assert len([line for line in lines if re.match(r"^[! ] +\d +\d+\.\d+ ± ", line)]) == 3
    (following,) = [line for line in lines if line.startswith("Next: ")]
    assert following == f"Next: ema add {out} spring@m2"

    code, text, err = ema(capsys, *following.removeprefix("Next: ema ").split())
    assert code == 0, err
    assert re.search(rf"base model +{re.escape(before)} ", text)
    assert f" {after} " in text.partition("base model")[2]
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["effects"] == ["spring@m2"]
    assert summary["diagnosis"]["on_top_of"] == []
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "The model now includes spring at m2" in report

    assert ema(capsys, "remove", out, "spring@m2")[0] == 0
    code, text, _ = ema(capsys, "ladder", out, "--json")
    assert json.loads(text)["effects"] == []
    code, text, _ = ema(capsys, "ladder", out)
    assert text.startswith("The model has no added effects. What the diagnosis proposes:")
    assert "The model holds spring" not in (out / "report.html").read_text(encoding="utf-8")


def test_modes_bear_the_same_numbers_and_differences_everywhere(
    crack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    stages = 'stages=["ingest", "hits", "frf", "modal", "ladder", "fit", "correlate", "report"]'
    code, text, err = ema(capsys, "run", crack, "--out", out, "--set", stages, *NO_FIGURES)
    assert code == 0, err
    shown = re.findall(r"^[! ] +(\d) +([\d.]+) ± .* ([+−]?[\d.]+) +[\d.]+$", text, flags=re.MULTILINE)
    assert [number for number, *_ in shown] == ["1", "2", "3"]
    with (out / "modes.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    listed = json.loads(ema(capsys, "compare", out, "--json")[1])["comparison"]["modes"]
    table = ema(capsys, "compare", out)[1]
    for (number, hertz, percent), row, mode in zip(shown, rows, listed, strict=True):
        assert int(number) == int(row["mode"]) == int(row["model_mode"]) == mode["mode"]
        assert float(row["frequency_hz"]) == pytest.approx(float(hertz), rel=1e-4)
        off = float(percent.replace("−", "-"))
        assert float(row["difference_percent"]) == pytest.approx(off, abs=0.006)
        assert mode["frequency_difference_percent"] == pytest.approx(off, abs=0.006)
        assert percent in table
    modes = json.loads((out / "summary.json").read_text(encoding="utf-8"))["configurations"]["default"][
        "modes"
    ]
    assert [m["mode"] for m in modes] == [1, 2, 3]
    for command in (["fit", out], ["ladder", out], ["levels", out], ["rigs"], ["reproduce", "planetary"]):
        code, text, err = ema(capsys, *command, "--json")
        assert code == 0, err
        assert json.loads(text)


def test_a_run_without_a_model_shows_its_modes_as_a_table(
    crack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "raw"
    raw.mkdir()
    for file in crack.iterdir():
        if file.name != "rig.toml":
            (raw / file.name).write_bytes(file.read_bytes())
    code, text, err = ema(
        capsys, "run", raw, "--out", tmp_path / "out", "--set", 'stages=["ingest", "hits", "frf", "modal"]'
    )
    assert code == 0, err
    assert text.startswith("3 modes from ")
    assert len(text.splitlines()) <= SCREEN_LINES
    assert len(re.findall(r"^[! ] +\d +[\d.]+ ± [\d.]+ +[\d.]+ ± [\d.]+ ", text, flags=re.MULTILINE)) == 3


def test_one_mode_has_one_frequency() -> None:
    modal = SimpleNamespace(modes=(SimpleNamespace(frequency_hz=60.01),))
    results = RunResults(
        "", configurations=(ConfigurationResults("default", modal=cast("ModalModel", modal)),)
    )
    assert run_screen.verdict_line(results) == "1 mode at 60.01 Hz; no model was named (--rig)."


def test_the_command_is_shown_as_it_can_be_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / ".venv" / "bin" / "ema"
    script.parent.mkdir(parents=True)
    script.write_text("#!/bin/sh\n", encoding="utf-8")
    script.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "/usr/bin")
    monkeypatch.setattr("sys.argv", [str(script), "run"])
    assert program() == ".venv/bin/ema"
    monkeypatch.setenv("PATH", str(script.parent))
    assert program() == "ema"


@pytest.mark.parametrize(("width", "shown"), [(84, 7), (80, 6), (70, 5), (56, 4), (36, 3)])
def test_modes_are_never_cut_off_at_the_edge_of_the_screen(width: int, shown: int) -> None:
    cells = ("no_ring", "10", "106.68136 ± 0.00086", "0.99971 ± 0.00073", "36.576", "−0.12", "0.98")
    least_first = ("36.576", "0.98", "−0.12", "0.99971 ± 0.00073")
    head = ("", "mode", "frequency, Hz", "damping, %", "model, Hz", "difference, %", "MAC")
    console = Console(width=width, file=io.StringIO())
    console.print(
        run_screen._fitted(Table(head, (Row(cells),), frozenset(range(1, 7))), str, console, console.options)
    )
    text = console.file.getvalue()  # type: ignore[attr-defined]
    left_out = least_first[: 7 - shown]
    assert [cell for cell in cells if cell in text] == [cell for cell in cells if cell not in left_out]
    assert len(text.splitlines()) == 2
