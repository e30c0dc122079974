"""The results file ``ema.h5``: one group per stage and configuration, safe against interruption at any moment.

Every change is made to a copy that replaces the file in one step, so that the file on disk is always
whole: either before the change or after it. So that the copy stays small, a large result is a file of its own in the
folder ``stages`` beside it, and the group is a link to that file, which any HDF5 tool follows. Such a file is complete
before the link is made, and is never changed.
"""

from __future__ import annotations

import contextlib
import datetime
import multiprocessing
import os
import platform
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
from filelock import FileLock, Timeout

from ema_pipeline import __version__, codec
from ema_pipeline.errors import EmaError
from ema_pipeline.files import ScratchFile, cannot_write, link_or_copy, reason, replacing
from ema_pipeline.processes import workers_die_with_us
from ema_pipeline.results_folder import BEFORE, LOCK_FILE, PARTS_FOLDER, RESULTS_FILE, bring_back_files

T = TypeVar("T")

ALL = "all"
"""Name that stands for all configurations together."""

LARGE_BYTES = 1_000_000
"""Size from which a result gets a file of its own: below, copying ``ema.h5`` costs less than the files' clutter."""

_PART = re.compile(re.escape(PARTS_FOLDER) + r"/[^/\\]+\.h5")
_FORMAT = 1
_LIBRARY = ("v110", "v110")


class CannotWriteError(EmaError):
    """A results folder cannot be written to: its results can still be read."""


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
        self._turns: contextlib.AbstractContextManager[object] = contextlib.nullcontext()

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
            raise CannotWriteError(
                f"{self.folder}: cannot write results there ({reason(error)}); copy it, or choose another with --out"
            ) from None
        with held, workers_die_with_us():
            if (
                type(lock) is FileLock
            ):  # where a file system knows no locks, filelock writes a mark of its own
                with contextlib.suppress(OSError):  # only a help to whoever finds the folder locked
                    path.write_text(f"{os.getpid()} {platform.node()}", encoding="utf-8")
            self._tidy()
            try:
                yield
            finally:
                self._tidy()

    @contextlib.contextmanager
    def shared(self) -> Iterator[None]:
        """While the block is open, processes forked from this one may save their results, too."""
        self._turns = multiprocessing.get_context("fork").Lock()
        try:
            yield
        finally:
            self._turns = contextlib.nullcontext()

    @contextlib.contextmanager
    def reading(self) -> Iterator[h5py.File]:
        """The HDF5 file, open for reading."""
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        except (OSError, RuntimeError) as error:  # h5py raises either on damaged content
            raise self._damaged(error) from None

    @contextlib.contextmanager
    def group(self, stage: str, configuration: str = ALL) -> Iterator[h5py.Group | None]:
        """What is stored of a stage, open for reading; None where there is nothing.

        Raises
        ------
        EmaError
            If the store is damaged, or if it leads elsewhere than to its own files.
        """
        if not self.path.is_file():
            yield None
            return
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(self.reading())
            stages = _find(file, f"stages/{stage}")
            link = None if stages is None else stages.get(configuration, getlink=True)
            if not isinstance(link, h5py.ExternalLink):
                yield _find(file, _group(stage, configuration))
                return
            part = self._part_of(link)
            file.close()  # the part is never changed, whatever becomes of the link
            # Left behind when the folder was copied, or deleted because it was damaged.
            if not part.is_file():
                yield None
                return
            try:
                yield stack.enter_context(h5py.File(part, "r"))
            except (OSError, RuntimeError) as error:
                raise EmaError(f"{part}: is damaged ({reason(error)}); delete it and run again") from None

    def _part_of(self, link: h5py.ExternalLink) -> Path:
        """The file that a link leads to, if it is one of ours."""
        part = self.folder / link.filename
        if (
            link.path != "/"
            or not _PART.fullmatch(link.filename)
            or part.is_symlink()
            or part.parent.is_symlink()
        ):
            raise EmaError(f"{self.path}: leads out of the folder, which ema never writes; do not trust it")
        return part

    @contextlib.contextmanager
    def changing(self) -> Iterator[h5py.File]:
        """A copy of the HDF5 file to change; it replaces the file when the block ends without an error."""
        with self._turns, replacing(self.path) as scratch:
            new = not self.path.exists()
            if not new:
                shutil.copyfile(self.path, scratch)
            with contextlib.closing(ScratchFile(scratch)) as disk:
                try:
                    with self._open_to_change(disk, new) as file:
                        yield file
                except (RuntimeError, KeyError) as error:  # h5py raises either on damaged content
                    disk.check()
                    raise self._damaged(error) from None
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

    def _damaged(self, error: Exception) -> EmaError:
        if not h5py.is_hdf5(self.path) and self.path.is_file():
            return EmaError(f"{self.path}: is not a readable HDF5 file; delete it and run again")
        return EmaError(f"{self.path}: is damaged ({reason(error)}); delete it and run again")

    def key(self, stage: str, configuration: str = ALL) -> str:
        """Key of the stored result, empty where there is none."""
        with self.group(stage, configuration) as group:
            return "" if group is None else _provenance(group).key

    def save(
        self, stage: str, configuration: str, key: str, settings: str, seconds: float, **results: Any
    ) -> None:
        """Replace a stage's results by new ones in one step."""
        scratch = self.folder / f".{stage}.{os.getpid()}.tmp"
        finished = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        try:
            with (
                contextlib.closing(ScratchFile(scratch)) as disk,
                h5py.File(disk, "w", libver=_LIBRARY) as file,
            ):
                codec.write(file, "provenance", Provenance(key, settings, __version__, finished, seconds))
                for name, value in results.items():
                    whole = _until_full(value, disk) if isinstance(value, Iterator) else value
                    codec.write(file, name, whole)
            disk.check()
            self._take(stage, configuration, key, scratch)
        except OSError as error:
            raise cannot_write(self.path, error) from None
        finally:
            with contextlib.suppress(OSError):
                scratch.unlink(missing_ok=True)

    def _take(self, stage: str, configuration: str, key: str, made: Path) -> None:
        """Take a stage's results from a complete file: a large one becomes ours as it is."""
        path = _group(stage, configuration)
        if made.stat().st_size >= LARGE_BYTES:
            part = f"{PARTS_FOLDER}/{stage}.{configuration}.{key[:16]}.h5"
            (self.folder / PARTS_FOLDER).mkdir(exist_ok=True)
            os.replace(made, self.folder / part)
            with self.changing() as file:
                if path in file:
                    del file[path]
                file[path] = h5py.ExternalLink(part, "/")
            return
        with self.changing() as file, h5py.File(made, "r") as new:
            if path in file:
                del file[path]
            new.copy("/", file, path)

    def copy_from(self, other: Store, stages: Iterable[str], names: Mapping[str, str]) -> None:
        """Copy what another store has of these stages, under other names of its configurations."""
        (self.folder / PARTS_FOLDER).mkdir(parents=True, exist_ok=True)
        with self.changing() as new, other.reading() as old:
            for path, now in (
                (_group(stage, a), _group(stage, b)) for stage in stages for a, b in names.items()
            ):
                link = old.get(path, getlink=True)
                if isinstance(link, h5py.ExternalLink):
                    part = other._part_of(link)
                    link_or_copy(part, self.folder / PARTS_FOLDER / part.name)
                    new[now] = link
                elif link is not None:
                    old.copy(path, new, now)

    def keep(self, stages: Collection[str]) -> None:
        """Drop the results of all other stages."""
        dropped = {stage for stage, _ in self.provenance()} - set(stages)
        if dropped:
            with self.changing() as file:
                for stage in dropped:
                    del file[f"stages/{stage}"]

    def parts(self) -> list[Path]:
        """The files of large results that the store refers to."""
        if not self.path.is_file():
            return []
        with self.reading() as file:
            stages = _find(file, "stages")
            links = [
                group.get(name, getlink=True)
                for stage in (() if stages is None else stages)
                for group in [_find(stages, stage)]
                if group is not None
                for name in group
            ]
            return [self._part_of(link) for link in links if isinstance(link, h5py.ExternalLink)]

    def _tidy(self) -> None:
        """Take back what killed processes have half changed; remove what they left and results that were replaced."""
        for before in self.folder.glob(f"{BEFORE}[0-9]*.tmp"):
            if before.is_dir() and not before.is_symlink() and (before / RESULTS_FILE).is_file():
                bring_back_files(self.folder, before)
                os.rename(before, before.with_name(f".done{before.suffixes[0]}.tmp"))
        for left_over in self.folder.glob(".*.[0-9]*.tmp"):
            if left_over.is_dir() and not left_over.is_symlink():
                shutil.rmtree(left_over, ignore_errors=True)
            else:
                left_over.unlink(missing_ok=True)
        folder = self.folder / PARTS_FOLDER
        if not folder.is_dir() or folder.is_symlink():
            return
        try:
            kept = self.parts()
        except EmaError:  # damaged: whoever reads it is told
            return
        for part in set(folder.glob("*.h5")) - set(kept):
            part.unlink(missing_ok=True)

    def load(
        self,
        stage: str,
        configuration: str,
        name: str,
        cls: type[T],
        left_out: Mapping[str, Any] | None = None,
    ) -> T:
        """Load one result of a stage; `left_out` as in `codec.read`.

        Raises
        ------
        EmaError
            If the stage has not been run.
        """
        result = self.find(stage, configuration, name, cls, left_out)
        if result is None:
            raise EmaError(f"{self.path}: holds no result of stage '{stage}' ({configuration}); run it first")
        return result

    def find(
        self,
        stage: str,
        configuration: str,
        name: str,
        cls: type[T],
        left_out: Mapping[str, Any] | None = None,
    ) -> T | None:
        """Load one result of a stage, None where there is none; `left_out` as in `codec.read`."""
        with self.group(stage, configuration) as group:
            if group is None or (name not in group and name not in group.attrs):
                return None
            try:
                result: T = codec.read(group, name, cls, left_out)
            except codec.MissingError:
                raise EmaError(
                    f"{self.path}: stage '{stage}' was written by another version of ema; "
                    f"bring everything up to date with 'ema run RAW --out {self.folder}'"
                ) from None
            return result

    def provenance(self) -> dict[tuple[str, str], Provenance]:
        """Provenance of everything in the store, by stage and configuration."""
        with self.reading() as file:
            stages = _find(file, "stages")
            places = [
                (stage, name)
                for stage in (() if stages is None else stages)
                for name in _find(stages, stage) or ()
            ]
        found = {}
        for stage, configuration in places:
            with self.group(stage, configuration) as group:
                if group is not None:
                    found[stage, configuration] = _provenance(group)
        return found


def _group(stage: str, configuration: str) -> str:
    return f"stages/{stage}/{configuration}"


def _provenance(group: h5py.Group) -> Provenance:
    """Where a stage's results come from; every version has written all of it."""
    try:
        found: Provenance = codec.read(group, "provenance", Provenance)
    except codec.MissingError as error:
        raise codec.DamagedError(f"{error.args[0]} is missing") from None
    return found


def _find(file: h5py.Group, path: str) -> h5py.Group | None:
    """The group at `path`, None where there is none.

    Raises
    ------
    DamagedError
        If an array is in its place.
    """
    group = file
    for step in path.split("/"):
        try:
            group = codec.member(group, step)
        except codec.MissingError:
            return None
        if not isinstance(group, h5py.Group):
            raise codec.DamagedError(f"{group.name} is an array where results are kept")
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
