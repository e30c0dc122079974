"""Files: read up to a limit, written whole or not at all."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError

if TYPE_CHECKING:
    from typing_extensions import Buffer


def check_regular(path: Path) -> int:
    """Size of a plain file, bytes; devices and pipes, which may never end, are refused.

    Raises
    ------
    EmaError
        If there is no such file, or if it is no plain file.
    """
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        raise EmaError(f"{path}: cannot be read ({reason(error)}); check the file and its rights") from None
    if stat.S_ISDIR(found.st_mode):
        raise EmaError(f"{path}: is a folder, not a file; name one file")
    if not stat.S_ISREG(found.st_mode):
        raise EmaError(f"{path}: is a device or a pipe, not a plain file; copy what it gives into a file")
    return found.st_size


def read_bounded(path: Path, largest_bytes: int) -> bytes:
    """The bytes of a plain file that is not larger than `largest_bytes`.

    Raises
    ------
    EmaError
        If the file cannot be read, is no plain file or is too large.
    """
    size = check_regular(path)
    if size > largest_bytes:
        raise EmaError(
            f"{path}: has {size / 1e6:.3g} MB where {largest_bytes / 1e6:.3g} MB are the most; "
            "is it the right file?"
        )
    try:
        with path.open("rb") as file:
            return file.read(largest_bytes)
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({reason(error)}); check the file and its rights") from None


def file_hash(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    EmaError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({error.strerror})") from None


def refuse_existing(
    paths: Iterable[Path], remedy: str = "name another folder with --to, or remove it"
) -> None:
    """Refuse to write files into a folder of the user's where one is there already.

    Raises
    ------
    EmaError
        Names the first that is there.
    """
    found = next((path for path in paths if path.exists()), None)
    if found is not None:
        raise EmaError(f"{found}: exists already and is kept; {remedy}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A scratch path to write to; it replaces `path` in one step when the block ends without an error.

    Raises
    ------
    EmaError
        If the disk is full, the folder cannot be written or `path` is a folder; what stood at `path` is left as it was.
    """
    if path.is_dir():
        raise EmaError(f"{path}: is a folder; name a file in it")
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield scratch
        os.replace(scratch, path)
    except OSError as error:
        raise cannot_write(path, error) from None
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def replace_file(path: Path, content: str | bytes) -> None:
    """Write a file in one step: a reader sees the old one or the new one, never half of one."""
    with replacing(path) as scratch:
        scratch.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def link_or_copy(source: Path, target: Path) -> None:
    """A hard link to a file that is never changed in place, or a copy where the file system has none.

    What is there under that name already stays.
    """
    try:
        os.link(source, target)
    except FileExistsError:
        return
    except OSError:
        shutil.copyfile(source, target)


def cannot_write(path: Path | str, error: OSError) -> EmaError:
    """What the user is told when a file could not be written."""
    return EmaError(f"{path}: cannot be written ({reason(error)}); free space, or choose another folder")


def reason(error: BaseException) -> str:
    """Why the system refused, in a few words."""
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list):
        return str(error.args[0][0][-1]).removesuffix(f": {error.args[0][0][0]!r}")  # the first of many files
    text = getattr(error, "strerror", None) or str(error).split("\n")[0]
    return text or type(error).__name__


class ScratchFile(io.RawIOBase):
    """A file for HDF5 to write to that keeps the first failure to itself.

    HDF5 crashes the whole process when it cannot write what it still holds as a file is closed, e.g. on a full
    disk. Here every write succeeds as far as HDF5 can see: after the first failure nothing more is written, and
    `check` raises that failure.

    Parameters
    ----------
    path : Path
        Created if it does not exist, else changed in place.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("r+b" if path.exists() else "w+b", buffering=0)
        self._failure: OSError | None = None

    def check(self) -> None:
        """Raise what went wrong so far.

        Raises
        ------
        OSError
        """
        if self._failure is not None:
            raise self._failure

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: Buffer, /) -> int:
        return self._file.readinto(memoryview(buffer).cast("B"))

    def write(self, data: Buffer, /) -> int:
        """Write all of `data`, or remember why that failed."""
        left = memoryview(data).cast("B")
        size = left.nbytes
        try:
            while left.nbytes and self._failure is None:
                left = left[self._file.write(left) :]
        except OSError as error:
            self._failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size of the file, or remember why that failed."""
        try:
            if self._failure is None:
                return self._file.truncate(size)
        except OSError as error:
            self._failure = error
        return size or 0

    def close(self) -> None:
        """Close the file; some file systems tell only now that there was no room."""
        if self.closed:
            return
        try:
            self._file.close()
        except OSError as error:
            self._failure = self._failure or error
        super().close()
