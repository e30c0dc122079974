"""The files of a results folder: their names, and how they go back together to an earlier state."""

from __future__ import annotations

from pathlib import Path

from ema_pipeline.files import link_or_copy, replacing

LOCK_FILE = ".lock"
RESULTS_FILE = "ema.h5"
PARTS_FOLDER = "stages"

FILES = (RESULTS_FILE, "summary.json", "modes.csv", "report.html")
"""Files of a results folder that go back together; large results beside them are never changed."""

BEFORE = ".before."
"""Begins the name of a folder with these files as they were before a change that is under way."""


def keep_files(folder: Path, place: Path) -> None:
    """Keep the files of a results folder as they are, in an empty folder of the same file system."""
    for name in FILES:
        if (folder / name).is_file():
            link_or_copy(folder / name, place / name)


def bring_back_files(folder: Path, place: Path) -> None:
    """Replace the files of a results folder by those that were kept in `place`; new ones go.

    `place` stays whole, so that this can be repeated if it is interrupted.
    """
    for name in reversed(FILES):  # the store last: until then the folder is in its later state
        if (place / name).is_file():
            with replacing(folder / name) as scratch:
                scratch.unlink(missing_ok=True)  # what a killed process of the same number left there
                link_or_copy(place / name, scratch)
        else:
            (folder / name).unlink(missing_ok=True)
