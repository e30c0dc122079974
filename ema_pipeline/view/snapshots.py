"""Earlier states of a results folder, for undo and cancel.

Every file of a results folder is replaced in one step, never changed in place. So a hard link to each of them is a
snapshot that costs no copy.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from ema_pipeline.errors import EmaError
from ema_pipeline.files import link_or_copy
from ema_pipeline.results_folder import PARTS_FOLDER, RESULTS_FILE, bring_back_files, keep_files
from ema_pipeline.store import Store

FOLDER = ".view-"
"""Begins the name of a server's folder of snapshots; its process number follows."""


class Snapshots:
    """Snapshots of one results folder, the latest last.

    Parameters
    ----------
    folder : Path
        Results folder.
    most : int
        Snapshots that are kept; each holds the disk space of one state.
    """

    def __init__(self, folder: Path, most: int = 20) -> None:
        self._folder = folder
        self._room = folder / f"{FOLDER}{os.getpid()}"
        self._most = most
        self._kept: list[Path] = []
        self._count = 0
        self.clear()
        for left_over in folder.glob(f"{FOLDER}*"):
            if not _running(left_over.name.removeprefix(FOLDER)):
                shutil.rmtree(left_over, ignore_errors=True)

    def __len__(self) -> int:
        return len(self._kept)

    def take(self) -> None:
        """Keep the state of the folder as it is now."""
        self._count += 1
        place = self._room / str(self._count)
        place.mkdir(parents=True)
        (place / PARTS_FOLDER).mkdir()
        for part in Store(self._folder).parts():
            link_or_copy(part, place / PARTS_FOLDER / part.name)
        keep_files(self._folder, place)
        self._kept.append(place)
        for old in self._kept[: -self._most]:
            shutil.rmtree(old, ignore_errors=True)
        self._kept = self._kept[-self._most :]

    def restore(self) -> None:
        """Bring the latest snapshot back, and forget it.

        Raises
        ------
        EmaError
            If another process is writing to the folder, or the snapshot is gone.
        """
        place = self._kept[-1]
        if not (place / RESULTS_FILE).is_file():
            raise EmaError(f"{place}: the earlier state is gone; take the change back with 'ema remove'")
        with Store(self._folder).lock():
            for part in (place / PARTS_FOLDER).iterdir():
                os.replace(part, self._folder / PARTS_FOLDER / part.name)
            bring_back_files(self._folder, place)
        self.drop()

    def drop(self) -> None:
        """Forget the latest snapshot."""
        shutil.rmtree(self._kept.pop(), ignore_errors=True)

    def clear(self) -> None:
        """Forget all."""
        self._kept = []
        shutil.rmtree(self._room, ignore_errors=True)


def _running(process: str) -> bool:
    """True for the number of a process of this machine that runs; of another user's too."""
    if not process.isdecimal() or len(process) > 9:
        return True  # none of ours
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
