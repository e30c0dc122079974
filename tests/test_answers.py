"""Which folders an answer may be written into."""

from __future__ import annotations

from pathlib import Path

import pytest

from ema_pipeline.answers import CHANGES_FILE, check_answer_folder
from ema_pipeline.errors import EmaError
from ema_pipeline.results_folder import RESULTS_FILE


@pytest.mark.parametrize("own", [RESULTS_FILE, CHANGES_FILE])
@pytest.mark.parametrize("name", ["modes.csv", "report.html", "summary.json"])
def test_a_file_that_the_program_did_not_write_is_not_replaced(tmp_path: Path, own: str, name: str) -> None:
    (tmp_path / "notes.txt").touch()
    check_answer_folder(tmp_path, own)
    (tmp_path / name).touch()
    with pytest.raises(EmaError, match=f"did not write {name}, .*name another with --out"):
        check_answer_folder(tmp_path, own)
    (tmp_path / own).touch()
    check_answer_folder(tmp_path, own)


def test_results_are_made_anew_where_theirs_were_deleted(tmp_path: Path) -> None:
    for name in ("summary.json", "report.html", "modes.csv"):
        (tmp_path / name).touch()
    check_answer_folder(tmp_path, RESULTS_FILE)


@pytest.mark.parametrize("below", [".", "with_ring"])
def test_no_results_are_written_beside_raw_data(tmp_path: Path, below: str) -> None:
    """Where they go into the folder of a campaign, a later run of a series leaves the whole campaign out."""
    (tmp_path / below).mkdir(exist_ok=True)
    (tmp_path / below / "test.toml").touch()
    with pytest.raises(EmaError, match="holds raw data, and results may replace files there; name another"):
        check_answer_folder(tmp_path, RESULTS_FILE)
