"""Readers of record files: one module per format, recognised by content and never by file name.

A reader is a module with ``NAME``, ``recognise(path, head)`` and ``read(path)``; adding one is adding its
module to `READERS` (see ``docs/adding_a_reader.md``).
"""

from __future__ import annotations

import gzip
import tempfile
import warnings
import zlib
from pathlib import Path
from typing import Protocol

from ema_pipeline.errors import EmaError
from ema_pipeline.files import check_regular
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers import hdf5, lvm, mat, tdms, text, uff, wav
from ema_pipeline.ingest.readers.apart import read_apart
from ema_pipeline.ingest.readers.failures import words_of
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord

__all__ = ["READERS", "RawChannel", "RawRecord", "Reader", "read_raw", "reader_of"]

_PIECE_BYTES = 1 << 20

HEAD_BYTES = 8192
"""What `recognise` gets to see of a file."""


class Reader(Protocol):
    """What a reader module offers."""

    @property
    def NAME(self) -> str:
        """The format's name as messages show it."""

    def recognise(self, path: Path, head: bytes) -> bool:
        """True where the first bytes of the file are of this format."""

    def read(self, path: Path, limits: ReadLimits) -> RawRecord:
        """Read the whole file. EmaErrors need not name the file: `read_raw` puts its name in front."""


READERS: tuple[Reader, ...] = (mat, hdf5, wav, tdms, lvm, uff, text)
"""All readers; the first that recognises a file reads it. Text comes last: it recognises any table."""

_FOREIGN = {
    b"PK\x03\x04": "a zip archive or an Excel workbook",
    b"\xd0\xcf\x11\xe0": "an old Excel or Word document",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a picture",
    b"\xff\xd8\xff": "a picture",
    b"\x93NUMPY": "a NumPy array",
    b"Rar!": "a rar archive",
    b"7z\xbc\xaf": "a 7z archive",
}


def read_raw(path: Path, limits: ReadLimits | None = None) -> RawRecord:
    """Read a record file of any supported format; gzip is unpacked on the way.

    Parameters
    ----------
    path : Path
        Record file.
    limits : ReadLimits, optional
        How large it may be.

    Returns
    -------
    RawRecord
        Channels as the file holds them, unscaled.

    Raises
    ------
    EmaError
        Where the file cannot be opened, is of an unknown format, is too large, is damaged, or holds no channels.
    """
    limits = limits or ReadLimits()
    head = _head(path)
    if head.startswith(b"\x1f\x8b"):
        return _read_gzip(path, limits)
    return _read(path, head, str(path), limits)


def reader_of(path: Path) -> Reader | None:
    """The reader that recognises a file (gzip is looked into), None where none does."""
    head = _head(path)
    if head.startswith(b"\x1f\x8b"):
        try:
            with gzip.open(path) as packed:
                head = packed.read(HEAD_BYTES)
        except (OSError, EOFError, zlib.error):
            return None
    return next((reader for reader in READERS if reader.recognise(path, head)), None)


def _head(path: Path) -> bytes:
    check_regular(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise EmaError(f"{path}: cannot be read ({error.strerror}); check the file and its rights") from None
    if not head:
        raise EmaError(f"{path}: is empty; copy or export it again")
    return head


def _read(path: Path, head: bytes, shown: str, limits: ReadLimits) -> RawRecord:
    reader = next((r for r in READERS if r.recognise(path, head)), None)
    if reader is None:
        foreign = next(
            (f" (it looks like {what})" for magic, what in _FOREIGN.items() if head.startswith(magic)), ""
        )
        known = ", ".join(r.NAME for r in READERS)
        raise EmaError(f"{shown}: unknown format{foreign}; export it as one of: {known}")
    try:
        with warnings.catch_warnings():
            # Readers' warnings would be lines on stderr that nobody can act on.
            warnings.simplefilter("ignore")
            limits.check_file(path.stat().st_size, text=reader in (text, lvm))
            apart = getattr(reader, "APART", None)
            record = reader.read(path, limits) if apart is None else read_apart(apart, path, limits)
    except EmaError as error:
        raise EmaError(f"{shown}: {error}") from None
    except MemoryError:
        raise EmaError(
            f"{shown}: takes more memory to read than there is; cut it into shorter ones"
        ) from None
    except Exception as error:
        # Third-party readers raise anything on damaged files; the user gets one line whatever it is.
        reason = words_of(error)
        raise EmaError(
            f"{shown}: cannot be read as {reader.NAME}{f' ({reason})' if reason else ''}; the file is damaged or cut "
            "short, copy or export it again"
        ) from error
    if not record.channels:
        why = f" ({'; '.join(record.notes[:3])})" if record.notes else ""
        raise EmaError(f"{shown}: holds no channels{why}; export the time data as numbers")
    return record


def _read_gzip(path: Path, limits: ReadLimits) -> RawRecord:
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "unpacked"
        _unpack(path, plain, limits)
        return _read(plain, _head(plain), str(path), limits).in_memory()


def _unpack(path: Path, plain: Path, limits: ReadLimits) -> None:
    """Unpack piece by piece, so that no more is written than the limits allow."""
    size, unpacked = path.stat().st_size, 0
    try:
        with gzip.open(path) as packed, plain.open("wb") as file:
            while piece := packed.read(_PIECE_BYTES):
                unpacked += len(piece)
                limits.check_unpacked(unpacked, size, "what is packed")
                file.write(piece)
    except EmaError as error:
        raise EmaError(f"{path}: {error}") from None
    except (OSError, EOFError, zlib.error) as error:
        raise EmaError(f"{path}: cannot be unpacked ({error}); copy it again") from None
    if unpacked == 0:
        raise EmaError(f"{path}: is empty once unpacked; copy or export it again")
