"""The results file ``ema.h5``: one group per stage and configuration, safe against a kill at any moment.

Every change is made to a copy that replaces the file in one step, so that the file on disk is always
whole: either before the change or after it.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
from filelock import FileLock, Timeout

from ema_pipeline import __version__, codec
from ema_pipeline.errors import EmaError
from ema_pipeline.files import ScratchFile, reason, replacing
from ema_pipeline.processes import workers_die_with_us

T = TypeVar("T")

ALL = "all"
"""Name that stands for all configurations together."""

LOCK_FILE = ".lock"
RESULTS_FILE = "ema.h5"

_FORMAT = 1
_LIBRARY = ("v110", "v110")


@dataclass(frozen=True)
class Provenance:
    """How a stage's result came about.

    Attributes
    ----------
    key : str
        Hash of the stage's inputs and settings; an equal key means that nothing has to be computed.
    settings : str
        The stage's settings, JSON.
    version : str
        Version of the program.
    finished : str
        UTC time, ISO 8601.
    seconds : float
        Time that the stage took.
    """

    key: str
    settings: str
    version: str
    finished: str
    seconds: float


class Store:
    """Results of one run.

    Parameters
    ----------
    folder : Path
        Results folder; the store is ``folder/ema.h5``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / RESULTS_FILE

    @classmethod
    def existing(cls, folder: Path) -> Store:
        """Open the store of a finished or interrupted run.

        Raises
        ------
        EmaError
            If there is none, or if it is not readable.
        """
        store = cls(folder)
        if not store.path.is_file():
            raise EmaError(f"{folder}: holds no ema.h5; make one with 'ema run RAW --out {folder}'")
        with store.reading():
            return store

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep a second process from writing to the same results folder.

        The lock belongs to this process alone: the system gives it up when the process ends, and processes
        forked from it neither inherit it nor outlive it.
        """
        path = self.folder / LOCK_FILE
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = FileLock(path, timeout=0)
            held = lock.acquire()
        except Timeout:
            raise EmaError(f"{self.folder}: {_holder(path)} is writing there; wait for it to end") from None
        except OSError as error:
            raise EmaError(
                f"{self.folder}: cannot write results there ({reason(error)}); choose another with --out"
            ) from None
        with held, workers_die_with_us():
            if (
                type(lock) is FileLock
            ):  # where a file system knows no locks, filelock writes a mark of its own
                with contextlib.suppress(OSError):  # only a help to whoever finds the folder locked
                    path.write_text(f"{os.getpid()} {platform.node()}", encoding="utf-8")
            for left_over in self.folder.glob(".*.[0-9]*.tmp"):
                left_over.unlink(missing_ok=True)
            yield

    @contextlib.contextmanager
    def reading(self) -> Iterator[h5py.File]:
        """The HDF5 file, open for reading."""
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except OSError as error:
            raise self._damaged(error) from None

    @contextlib.contextmanager
    def changing(self) -> Iterator[h5py.File]:
        """A copy of the HDF5 file to change; it replaces the file when the block ends without an error."""
        with self._changing() as (file, _):
            yield file

    @contextlib.contextmanager
    def _changing(self) -> Iterator[tuple[h5py.File, ScratchFile]]:
        with replacing(self.path) as scratch:
            new = not self.path.exists()
            if not new:
                shutil.copyfile(self.path, scratch)
            with contextlib.closing(ScratchFile(scratch)) as disk, self._open_to_change(disk, new) as file:
                yield file, disk
            disk.check()

    def _open_to_change(self, disk: ScratchFile, new: bool) -> h5py.File:
        """The newer file format guards all that describes the data by checksums."""
        try:
            if not new:
                return h5py.File(disk, "r+", libver=_LIBRARY)
            file = h5py.File(disk, "w", libver=_LIBRARY, fs_strategy="fsm", fs_persist=True)
        except OSError as error:
            disk.check()
            raise self._damaged(error) from None
        file.attrs["format"] = _FORMAT
        return file

    def _damaged(self, error: OSError) -> EmaError:
        if not h5py.is_hdf5(self.path) and self.path.is_file():
            return EmaError(f"{self.path}: is not a readable HDF5 file; delete it and run again")
        return EmaError(f"{self.path}: is damaged ({reason(error)}); delete it and run again")

    def key(self, stage: str, configuration: str = ALL) -> str:
        """Key of the stored result, empty where there is none."""
        if not self.path.is_file():
            return ""
        with self.reading() as file:
            group = _find(file, _group(stage, configuration))
            return "" if group is None else str(codec.read(group, "provenance", Provenance).key)

    def save(
        self, stage: str, configuration: str, key: str, settings: str, seconds: float, **results: Any
    ) -> None:
        """Replace a stage's results by new ones in one step."""
        with self._changing() as (file, disk):
            watched = {
                name: _until_full(value, disk) if isinstance(value, Iterator) else value
                for name, value in results.items()
            }
            write_stage(file, stage, configuration, key, settings, seconds, **watched)

    def load(self, stage: str, configuration: str, name: str, cls: type[T]) -> T:
        """Load one result of a stage.

        Raises
        ------
        EmaError
            If the stage has not been run.
        """
        result = self.find(stage, configuration, name, cls)
        if result is None:
            raise EmaError(f"{self.path}: holds no result of stage '{stage}' ({configuration}); run it first")
        return result

    def find(self, stage: str, configuration: str, name: str, cls: type[T]) -> T | None:
        """Load one result of a stage, None where there is none."""
        if not self.path.is_file():
            return None
        with self.reading() as file:
            group = _find(file, _group(stage, configuration))
            if group is None or (name not in group and name not in group.attrs):
                return None
            try:
                result: T = codec.read(group, name, cls)
            except codec.MissingError:
                raise EmaError(
                    f"{self.path}: stage '{stage}' was written by another version of ema; run it again"
                ) from None
            return result

    def provenance(self) -> dict[tuple[str, str], Provenance]:
        """Provenance of everything in the store, by stage and configuration."""
        found: dict[tuple[str, str], Provenance] = {}
        with self.reading() as file:
            stages = _find(file, "stages")
            for stage in () if stages is None else stages:
                configurations = codec.member(stages, stage)
                for configuration in configurations:
                    group = codec.member(configurations, configuration)
                    found[stage, configuration] = codec.read(group, "provenance", Provenance)
        return found


def write_stage(
    file: h5py.File, stage: str, configuration: str, key: str, settings: str, seconds: float, **results: Any
) -> h5py.Group:
    """Write a stage's results and provenance into an open file; returns the stage's group."""
    path = _group(stage, configuration)
    if path in file:
        del file[path]
    group = file.create_group(path)
    finished = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    codec.write(group, "provenance", Provenance(key, settings, __version__, finished, seconds))
    for name, value in results.items():
        codec.write(group, name, value)
    return group


def _group(stage: str, configuration: str) -> str:
    return f"stages/{stage}/{configuration}"


def _find(file: h5py.File, path: str) -> h5py.Group | None:
    """The group at `path`, None where there is none."""
    group = file
    for step in path.split("/"):
        try:
            group = codec.member(group, step)
        except codec.MissingError:
            return None
    return group


def _until_full(items: Iterator[T], disk: ScratchFile) -> Iterator[T]:
    """The items, as long as there is room for them: making them takes longer than writing them."""
    for item in items:
        disk.check()
        yield item


def _holder(path: Path) -> str:
    """Who holds the lock, as far as the lock file tells."""
    try:
        process, _, machine = path.read_text(encoding="utf-8").partition(" ")
    except (OSError, UnicodeDecodeError):
        return "another ema process"
    if not process.isdecimal() or len(process) > 20:
        return "another ema process"
    return f"another ema process (number {process} on {machine[:64]})"
