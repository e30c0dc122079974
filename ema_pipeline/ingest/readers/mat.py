"""MATLAB files: version 5 (scipy) and 7.3 (HDF5 in disguise)."""

from __future__ import annotations

import itertools
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.hdf5 import Budget, small_attributes, walk
from ema_pipeline.ingest.readers.raw import RawRecord

NAME = "MAT"

APART = "mat"
"""Read in a process apart: version 7.3 is HDF5, and version 5 may unpack to anything."""

_HEADER_BYTES = 128
_PACKED = 15  # miCOMPRESSED
_LONGEST_TEXT = 10_000
_CHARACTER_BYTES = 2

_NUMERIC = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}


def recognise(path: Path, head: bytes) -> bool:
    """True for the text that MATLAB writes at the start of both versions."""
    return head.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"))


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read every numeric variable, and the fields of structs."""
    with path.open("rb") as file:
        newer = file.read(10) == b"MATLAB 7.3"
    arrays, packed = _read_73(path, limits) if newer else _read_5(path, limits)
    record = assemble(_with_label_units(arrays), limits=limits)
    notes = tuple(
        f"'{'/'.join(steps)}' is a cell or struct array and is left out; save its vectors as variables"
        for steps in packed
    )
    return replace(record, notes=record.notes + notes)


def _read_5(path: Path, limits: ReadLimits) -> tuple[list[NamedArray], list[tuple[str, ...]]]:
    """What the variables and the fields of structs hold, and the paths of arrays of arrays or structs."""
    from scipy.io import loadmat

    _check_variables(path, limits)
    arrays: list[NamedArray] = []
    packed: list[tuple[str, ...]] = []
    left: list[tuple[tuple[str, ...], Any]] = [
        ((name,), value)
        for name, value in loadmat(str(path), struct_as_record=False).items()
        if not name.startswith("__")
    ]
    while left:
        steps, value = left.pop(0)
        values = np.asarray(value)
        items = values.ravel() if values.dtype == object else np.empty(0)
        if items.size == 1 and hasattr(items[0], "_fieldnames"):
            left[:0] = [((*steps, field), getattr(items[0], field)) for field in items[0]._fieldnames]
        elif any(hasattr(x, "_fieldnames") or _is_vector(x) for x in items):
            packed.append(steps)
        else:
            arrays.append(NamedArray(steps, values))
    return arrays, packed


def _is_vector(item: Any) -> bool:
    return isinstance(item, np.ndarray) and item.dtype.kind in "fiu" and item.size > 1


def _check_variables(path: Path, limits: ReadLimits) -> None:
    """Add up what the variables say of their sizes; packed ones say it at the start of what is packed."""
    size, unpacked, count = path.stat().st_size, 0, 0
    with path.open("rb") as file:
        order = "<" if file.read(_HEADER_BYTES)[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            start = file.tell()
            if kind == _PACKED:
                inner = zlib.decompressobj().decompress(file.read(min(length, 256)), 8)
                unpacked += struct.unpack(f"{order}II", inner)[1] if len(inner) == 8 else 0
            else:
                unpacked += length
            count += 1
            limits.check_channels(count)
            limits.check_unpacked(unpacked, size, f"variable {count}")
            file.seek(start + length)


def _read_73(path: Path, limits: ReadLimits) -> tuple[list[NamedArray], list[tuple[str, ...]]]:
    """The same of a file of version 7.3."""
    import h5py

    arrays: list[NamedArray] = []
    packed: list[tuple[str, ...]] = []
    with h5py.File(path, "r") as file:
        budget = Budget(path, limits)
        for steps, item in walk(file, limits):
            if steps[0].startswith("#") or not isinstance(item, h5py.Dataset) or item.shape is None:
                continue
            budget.take(item)
            attributes = small_attributes(item)
            kind = attributes.get("MATLAB_class", b"double")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            if kind in _NUMERIC and "MATLAB_empty" not in attributes and item.dtype.kind in "fiu":
                arrays.append(NamedArray(steps, item[()].T))
            elif kind == "char" and item.dtype.kind == "u":
                arrays.append(NamedArray(steps, np.asarray(_characters(item))))
            elif item.dtype == h5py.ref_dtype:
                limits.check_channels(item.size)
                if any(_is_packed(file[reference]) for reference in np.ravel(item[()]) if reference):
                    packed.append(steps)
                    continue
                texts = [
                    _characters(file[reference]) if reference else "" for reference in np.ravel(item[()])
                ]
                arrays.append(NamedArray(steps, np.asarray(texts)))
    return arrays, packed


def _is_packed(item: Any) -> bool:
    """True for the vectors and structs that a cell or a struct array holds."""
    if not hasattr(item, "dtype"):
        return True
    return item.dtype.kind in "fi" and (item.size or 0) > 1


def _characters(dataset: Any) -> str:
    """The text of a character array; none of anything else that a cell may hold."""
    import h5py

    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind != "u" or not dataset.size:
        return ""
    if dataset.size > _LONGEST_TEXT or dataset.dtype.itemsize > _CHARACTER_BYTES:
        return ""
    return np.ravel(dataset[()]).astype("<u2").tobytes().decode("utf-16-le", errors="replace")


def _with_label_units(arrays: list[NamedArray]) -> list[NamedArray]:
    """Take units from the label list of SignalCalc exports: ``Signal X1``, ``Real EU N``, ``0-Z:0-Z``, …"""
    labels: NDArray[Any] | None = next((np.ravel(a.values) for a in arrays if a.name == "DP_Info"), None)
    if labels is None:
        return arrays
    texts = [str(t).strip() for t in labels]
    units = {
        head.removeprefix("Signal "): kind.split()[-1]
        for head, kind in itertools.pairwise(texts)
        if head.startswith("Signal ") and kind.startswith("Real EU ")
    }
    return [NamedArray(a.path, a.values, {"unit": units[a.name]} if a.name in units else {}) for a in arrays]
