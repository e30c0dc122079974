"""What a folder of results holds the answer to: a test, a series of tests, or two tests compared."""

from __future__ import annotations

from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.description import DESCRIPTION_FILE
from ema_pipeline.results_folder import FILES, RESULTS_FILE

SERIES_FILE, CHANGES_FILE = "series.db", "changes.json"

ANSWERS = {
    RESULTS_FILE: "the results of a test",
    SERIES_FILE: "a series of tests",
    CHANGES_FILE: "a comparison of two tests",
}
"""Files by whose names a folder is known to hold an answer, and of what."""

_TOGETHER = {"summary.json", "report.html"}
"""Files of a run that stay together, also where its results were deleted."""


def check_answer_folder(folder: Path, own: str) -> None:
    """Refuse a folder that holds an answer of another kind, raw data, or files of the user's that would be replaced.

    Parameters
    ----------
    folder : Path
    own : str
        The file of `ANSWERS` that an earlier answer of the same kind may have left there.

    Raises
    ------
    EmaError
        Also where the folder is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise EmaError(f"{folder}: is no folder; name another with --out")
    raw = (folder / DESCRIPTION_FILE).is_file() or any(folder.glob(f"*/{DESCRIPTION_FILE}"))
    if raw and not (folder / own).is_file():
        raise EmaError(
            f"{folder}: holds raw data, and results may replace files there; name another with --out"
        )
    for name, words in ANSWERS.items():
        if name != own and (folder / name).is_file():
            raise EmaError(f"{folder}: holds {words}, whose report would be lost; name another with --out")
    others = [name for name in FILES if (folder / name).exists()]
    if others and not (folder / own).is_file() and not set(others) >= _TOGETHER:
        raise EmaError(
            f"{folder}: ema did not write {others[0]}, and would replace it; name another with --out"
        )
