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

from ema_pipeline.errors import EmaError
from ema_pipeline.files import cannot_write
from ema_pipeline.results_folder import BEFORE, bring_back_files, keep_files
from ema_pipeline.run.opening import load_info, save_info
from ema_pipeline.run.types import RunInfo
from ema_pipeline.store import Store


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

    So they do if the process is killed: then by whoever locks the store next. The lock of the store must be held from
    before to after: large results that were replaced are kept until then.
    """
    making = store.folder / f".keeping.{os.getpid()}.tmp"
    place = store.folder / f"{BEFORE}{os.getpid()}.tmp"
    try:
        try:
            making.mkdir()
            keep_files(store.folder, making)
            os.rename(making, place)  # complete from its first moment on
        except OSError as error:
            raise cannot_write(store.path, error) from None
        with _taken_back(Change(), lambda: bring_back_files(store.folder, place)) as change:
            save_info(store, info)
            yield change
    finally:
        with contextlib.suppress(OSError):  # in one step it no longer counts; then it may go bit by bit
            os.rename(place, making)
        shutil.rmtree(making, ignore_errors=True)


@contextlib.contextmanager
def _taken_back(change: Change, take_back: Callable[[], None]) -> Iterator[Change]:
    try:
        yield change
    except BaseException as error:
        if isinstance(error, Exception) or not change.resumable:
            with contextlib.suppress(EmaError, OSError):  # it is the error of the change that is told
                take_back()
        raise
