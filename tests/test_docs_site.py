"""The documentation: its tutorial runs as it is printed, its site builds without a warning."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_the_tutorial_runs_and_gives_the_numbers_that_it_prints() -> None:
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    printed = nbformat.read(ROOT / "docs" / "tutorial.ipynb", 4)
    run = nbformat.from_dict(printed)
    place = {"metadata": {"path": str(ROOT / "docs")}}
    client.NotebookClient(run, timeout=900, resources=place).execute()
    numbers = [o["text"] for cell in run.cells for o in cell.get("outputs", ()) if o.output_type == "stream"]
    value, std = map(float, numbers[-1].partition(" of ")[0].split(" ± "))
    assert abs(value - 0.35) < std < 0.025
    assert numbers[-1] == printed.cells[-2].outputs[-1]["text"]
    assert any("mesh stiffness loss at sun-planet1" in str(cell.get("outputs")) for cell in run.cells)


def test_every_path_of_the_page_on_architecture_exists() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = page.partition("## Where is it?")[2].partition("\n## ")[0]
    named = re.findall(r"`([\w/]+\.(?:py|js)|[\w/]+/)`", table)
    assert len(named) > 25
    named += re.findall(r"`([a-z_]+/[\w/]+\.py)`", page)
    assert not [path for path in named if not (ROOT / "ema_pipeline" / path).exists()]


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs_jupyter")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    settings = (tmp_path / "site" / "settings.html").read_text(encoding="utf-8")
    assert "least_mac" in settings
    assert "ema ladder" in (tmp_path / "site" / "commands.html").read_text(encoding="utf-8")
