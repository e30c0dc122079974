"""HDF5: datasets at the root or in groups, with units and sample rate in attributes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.raw import RawRecord, StoredFile, StoredSamples
from ema_pipeline.ingest.readers.timebase import is_time_name

if TYPE_CHECKING:
    import h5py

NAME = "HDF5"

APART = "hdf5"
"""Read in a process apart: damaged files crash the HDF5 library."""

LONG = 16_384
"""Vectors of at least so many numbers stay in the file until they are needed."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_DEEPEST = 64
"""Groups within groups; measurements have three or four."""

_LONGEST_NAME = 1000
_LARGEST_ATTRIBUTE = 65_536
"""Bytes; units, names and rates are far smaller, and nothing else is looked for."""

_MOST_TEXTS = 10_000


def recognise(path: Path, head: bytes) -> bool:
    """True where the HDF5 signature stands at the start or behind a user block."""
    return any(head[at : at + 8] == SIGNATURE for at in (0, 512, 1024, 2048)) and not head.startswith(
        b"MATLAB"
    )


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read every numeric dataset of the file."""
    import h5py

    arrays: list[NamedArray] = []
    groups: dict[tuple[str, ...], Mapping[str, Any]] = {}
    with h5py.File(path, "r") as file:
        attributes = dict(small_attributes(file))
        budget, stored = Budget(path, limits), StoredFile(path)
        for at, item in walk(file, limits):
            if isinstance(item, h5py.Group):
                groups[at] = small_attributes(item)
            elif item.shape is not None and item.dtype.names is not None:
                arrays.extend(_fields(at, item, budget))
            elif item.shape is not None:
                found = _array(stored, at, item, budget)
                if found is not None:
                    arrays.append(found)
    holders = {a.path[:depth] for a in arrays for depth in range(1, len(a.path)) if np.size(a.values) > 1}
    stated: dict[str, Mapping[str, Any]] = {}
    for at, own in groups.items():
        if at in holders:
            stated[f"group '{'/'.join(at)}'"] = own
        else:  # what stands apart from the samples may speak of the whole file
            attributes = {**own, **attributes}
    return assemble(arrays, {"file attributes": attributes, **stated}, limits)


def _array(stored: StoredFile, at: tuple[str, ...], item: h5py.Dataset, budget: Budget) -> NamedArray | None:
    import h5py

    budget.take(item)
    if item.ndim == 1 and item.size >= LONG and item.dtype.kind in "fiu" and not is_time_name(at[-1]):
        return NamedArray(at, StoredSamples(stored, "/".join(at), item.size), small_attributes(item))
    if h5py.check_string_dtype(item.dtype) is None:
        values = item[()] if item.dtype.kind in "fiuc" else None
    else:
        values = item.asstr(errors="replace")[()] if item.size <= _MOST_TEXTS else None
    # An h5py string array may come back as a plain str; numpy makes both arrays.
    return None if values is None else NamedArray(at, np.asarray(values), small_attributes(item))


def _fields(at: tuple[str, ...], item: h5py.Dataset, budget: Budget) -> list[NamedArray]:
    """The columns of a table; those of a spectrum's real and imaginary parts are none."""
    budget.take(item)
    if item.ndim != 1 or {name.casefold() for name in item.dtype.names} >= {"real", "imag"}:
        return []
    rows, attributes = item[()], small_attributes(item)
    numbers = [name for name in rows.dtype.names if rows.dtype[name].kind in "fiu"]
    return [NamedArray((*at, name), rows[name], attributes if name == numbers[0] else {}) for name in numbers]


class Budget:
    """How much a file may still unpack to."""

    def __init__(self, path: Path, limits: ReadLimits) -> None:
        self._file_bytes, self._limits = path.stat().st_size, limits
        self._taken = 0

    def take(self, item: h5py.Dataset) -> None:
        """Count a dataset before it is read.

        Raises
        ------
        EmaError
            If it keeps its numbers elsewhere, or if it is out of proportion to the file.
        """
        name = str(item.name)[:_LONGEST_NAME]
        if item.external or item.is_virtual:
            raise EmaError(f"dataset '{name}' keeps its numbers in another file; copy them into this one")
        self._taken += int(item.size or 0) * max(8, item.dtype.itemsize)
        self._limits.check_unpacked(self._taken, self._file_bytes, f"dataset '{name}'")


def walk(file: h5py.File, limits: ReadLimits) -> Iterator[tuple[tuple[str, ...], h5py.Group | h5py.Dataset]]:
    """Every group and dataset of the file itself with its path, each once; links to elsewhere are not followed.

    Raises
    ------
    EmaError
        For more objects, deeper groups or longer names than any measurement has.
    """
    seen: set[int] = set()
    yield from _below(file, (), seen, limits)


def _below(
    group: h5py.Group, path: tuple[str, ...], seen: set[int], limits: ReadLimits
) -> Iterator[tuple[tuple[str, ...], h5py.Group | h5py.Dataset]]:
    import h5py

    limits.check_channels(len(seen) + len(group))
    if len(path) >= _DEEPEST:
        raise EmaError(f"has groups within groups, more than {_DEEPEST} deep; export the time data alone")
    for name in group:
        if len(name) > _LONGEST_NAME:
            raise EmaError(f"has a name of {len(name)} characters ('{name[:30]}…'); shorten it")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            continue
        seen.add(address)
        if isinstance(item, h5py.Group | h5py.Dataset):
            yield (*path, name), item
        if isinstance(item, h5py.Group):
            yield from _below(item, (*path, name), seen, limits)


def small_attributes(item: h5py.Group | h5py.Dataset) -> Mapping[str, Any]:
    """Attributes of a reasonable size that hold something; others say nothing that is looked for."""
    import h5py

    found = {}
    for name in item.attrs:
        described = item.attrs.get_id(name)
        size = int(np.prod(described.shape or (1,))) * described.dtype.itemsize
        if size <= _LARGEST_ATTRIBUTE and not isinstance(value := item.attrs[name], h5py.Empty):
            found[name] = value
    return found
