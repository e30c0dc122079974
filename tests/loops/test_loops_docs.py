"""The example on the isolator's page runs as it is printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method_isolator.md"


@pytest.mark.slow
def test_python_example_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    namespace: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), namespace)
    damping = namespace["result"].parameters["viscous_damping"]  # type: ignore[attr-defined]
    assert damping.value == pytest.approx(39.69, rel=0.05)
    assert (tmp_path / "isolator" / "test.toml").is_file()


def test_toml_example_of_the_page_is_a_valid_description(tmp_path: Path) -> None:
    from ema_pipeline.ingest.description import read_description

    (text,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    (tmp_path / "test.toml").write_text(text, encoding="utf-8")
    (tmp_path / "12Hz_1mm.csv").write_text("force,displacement\n0,0\n", encoding="utf-8")
    assert read_description(tmp_path).kind == "hysteresis"
