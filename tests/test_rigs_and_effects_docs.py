"""The examples of the pages on rigs and effects run as they are printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ema_pipeline.rigs import load_rig, model_modes

DOCS = Path(__file__).parent.parent / "docs"


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.mark.parametrize("index", [0, 1])
def test_rig_files_of_the_page_on_rigs_load(tmp_path: Path, index: int) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(blocks("adding_a_rig.md", "toml")[index], encoding="utf-8")
    rig = load_rig(file)
    assert rig.name in ("my gearbox", "two blocks")
    for configuration in rig.configurations:
        assert model_modes(rig, configuration)


def test_python_rig_of_the_page_on_rigs_runs() -> None:
    (code,) = blocks("adding_a_rig.md", "python")
    exec(code, {"__name__": "example"})


def test_effect_of_the_page_on_effects_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    effect, use = blocks("adding_an_effect.md", "python")
    (tmp_path / "oil_film.py").write_text(effect, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(use, {"__name__": "example"})
    assert capsys.readouterr().out == "400000.0\n"
