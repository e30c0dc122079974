"""Changes of a results folder that are taken back if they fail.

Every file of a results folder is replaced in one step, never changed in place. So a hard link to a file keeps what it
held, without a copy.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.files import cannot_write, link_or_copy
from ema_pipeline.run.opening import load_info, save_info
from ema_pipeline.run.types import RunInfo
from ema_pipeline.store import RESULTS_FILE, Store

FILES = (RESULTS_FILE, "summary.json", "modes.csv", "report.html")
"""Files of a results folder that go back together; large results beside them are never changed."""


@dataclasses.dataclass
class Change:
    """A change that is under way.

    Attributes
    ----------
    resumable : bool
        Whether an interrupted change can be finished: then an interruption leaves what is there. A failure never does.
    """

    resumable: bool = False


@contextlib.contextmanager
def settings_taken_back(store: Store, info: RunInfo) -> Iterator[Change]:
    """Describe a run whose stages follow; if one fails, settings and effect files go back and finished stages stay.

    An interrupted run keeps its settings and goes on with them. A description of other data or another rig stays.
    """
    before = load_info(store) if store.path.is_file() else None
    save_info(store, info)

    def take_back() -> None:
        if before is not None and before == dataclasses.replace(
            info, pipeline=before.pipeline, effect_hashes=before.effect_hashes, versions=before.versions
        ):
            save_info(store, before)

    with _taken_back(Change(resumable=True), take_back) as change:
        yield change


@contextlib.contextmanager
def everything_taken_back(store: Store, info: RunInfo) -> Iterator[Change]:
    """Describe the run anew; if what follows fails or is interrupted, description, results and report go back.

    The lock of the store must be held from before to after: large results that were replaced are kept until then.
    """
    place = store.folder / f".before.{os.getpid()}.tmp"
    try:
        try:
            place.mkdir()
            keep_files(store.folder, place)
        except OSError as error:
            raise cannot_write(store.path, error) from None
        with _taken_back(Change(), lambda: bring_back_files(store.folder, place)) as change:
            save_info(store, info)
            yield change
    finally:
        shutil.rmtree(place, ignore_errors=True)


@contextlib.contextmanager
def _taken_back(change: Change, take_back: Callable[[], None]) -> Iterator[Change]:
    try:
        yield change
    except BaseException as error:
        if isinstance(error, Exception) or not change.resumable:
            with contextlib.suppress(EmaError, OSError):  # it is the error of the change that is told
                take_back()
        raise


def keep_files(folder: Path, place: Path) -> None:
    """Keep the files of a results folder as they are, in an empty folder of the same file system."""
    for name in FILES:
        if (folder / name).is_file():
            link_or_copy(folder / name, place / name)


def bring_back_files(folder: Path, place: Path) -> None:
    """Replace the files of a results folder by those that were kept in `place`; new ones go."""
    for name in reversed(FILES):  # the store last: until then the folder is in its later state
        if (place / name).is_file():
            os.replace(place / name, folder / name)
        else:
            (folder / name).unlink(missing_ok=True)
