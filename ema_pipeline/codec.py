"""Frozen dataclasses to HDF5 and back, by their type annotations.

The layout is meant to be read with any HDF5 viewer: scalars are attributes, arrays are datasets, nested
dataclasses and dictionaries are groups, a tuple of plain records is a table (compound dataset), a tuple of
anything else is a group with members ``0``, ``1``, … An iterator is written like a tuple, one item at a
time, and `LazySamples` like an array, one row at a time, so that they need not fit into memory. DOFs are written as
text (``"sun.x"``).

Damage is seen when it is read: every array carries a Fletcher-32 checksum, and text is stored with its length
fixed, because HDF5 keeps text of variable length in a heap without one. Attributes are guarded by the checksums
of the file format itself (HDF5 1.10 and later). Files come from strangers too, so links and arrays that lead out
of the file are refused.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Hashable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import h5py
import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.files import reason
from ema_pipeline.lazy_samples import LazySamples

T = TypeVar("T")

_ALL: Mapping[str, Any] = types.MappingProxyType({})
_SCALARS = (bool, int, float, complex, str)
_NONE = "__none__"
_COMPRESS_FROM_BYTES = 16_384
_ROW_CHUNK = 65_536
"""Numbers of a row that are checked together, 0.5 or 1 MB: a part of it is read without reading the whole row."""

_PROBES = 1_000
"""Numbers of an array that are looked at to see whether it is worth compressing."""

_SMALL_BYTES, _BEST_PACKING = 64_000_000, 300
"""Even zeros are packed no better than 1:300 by the filter that is used here."""

_LONGEST_ATTRIBUTE = 32_768
"""Longer text, bytes, becomes an array: HDF5 keeps attributes of more than 64 KiB apart from their object."""


class MissingError(KeyError):
    """The file was written by a version of the program that did not store this."""


class DamagedError(OSError):
    """The file holds something else than what was written."""


def write(parent: h5py.Group, name: str, value: Any) -> None:
    """Write `value` (see the module's description for what is allowed) as member `name` of `parent`."""
    if value is None:
        _write_text(parent, name, _NONE)
    elif isinstance(value, Dof | Path | str):
        _write_text(parent, name, str(value))
    elif isinstance(value, (*_SCALARS, np.generic)):
        parent.attrs[name] = value
    elif isinstance(value, np.ndarray):
        _write_array(parent, name, value)
    elif isinstance(value, LazySamples):
        dataset = parent.create_dataset(
            name,
            shape=value.shape,
            dtype=np.float64,
            chunks=(1, _share(value.shape[1], _ROW_CHUNK)),
            fletcher32=True,
        )
        with value.held_open():
            for row in range(len(value)):
                dataset[row] = value[row]
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        group = parent.create_group(name)
        for field in dataclasses.fields(value):
            write(group, field.name, getattr(value, field.name))
    elif isinstance(value, dict):
        group = parent.create_group(name)
        for key, item in value.items():
            write(group, _escape(str(key)), item)
    elif isinstance(value, tuple | list):
        _write_tuple(parent, name, tuple(value))
    elif isinstance(value, Iterator):
        group = parent.create_group(name)
        for index, item in enumerate(value):
            write(group, str(index), item)
    else:
        raise TypeError(f"cannot store {type(value).__name__} as '{name}'")


def read(parent: h5py.Group, name: str, annotation: Any, left_out: Mapping[str, Any] | None = None) -> Any:
    """Read member `name` of `parent` as the annotated type.

    Parameters
    ----------
    parent : h5py.Group
    name : str
    annotation : type
    left_out : mapping of str, optional
        Fields of a dataclass that are not read, with what stands in their place.

    Raises
    ------
    MissingError
        If it is not there.
    EmaError
        If it leads out of the file.
    DamagedError
        If it is not what `write` has written.
    """
    try:
        return _read(parent, name, annotation, left_out or {})
    except (EmaError, MissingError, DamagedError):
        raise
    except Exception as error:  # h5py and the types to be made raise anything on damaged content
        where = f"{parent.name}/{name}" if parent else name
        raise DamagedError(f"'{where}': {reason(error)}") from error


def _read(parent: h5py.Group, name: str, annotation: Any, left_out: Mapping[str, Any] = _ALL) -> Any:
    annotation, optional = _strip_optional(annotation)
    if name in parent.attrs:
        raw = parent.attrs[name]
        return None if optional and _is_none(raw) else _scalar(raw, annotation)
    node = member(parent, name)
    origin = typing.get_origin(annotation)
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return _read_dataclass(node, annotation, left_out)
    if origin is tuple:
        return _read_tuple(node, typing.get_args(annotation))
    if origin is dict:
        _, item = typing.get_args(annotation)
        return {_unescape(k): _read(node, k, item) for k in (*node.attrs, *node)}
    if annotation in (str, Path):
        return _scalar(node[()].tobytes(), annotation)
    return node[()]


def member(parent: h5py.Group, name: str) -> h5py.Group | h5py.Dataset:
    """A group or dataset that lies in this file itself.

    Raises
    ------
    MissingError
        If there is none of that name.
    EmaError
        If it leads to another file, so that reading it would show whatever file its maker chose.
    DamagedError
        If what describes it is damaged.
    """
    try:
        link = parent.get(name, getlink=True)
        node = parent[name] if isinstance(link, h5py.HardLink) else None
    except Exception as error:  # h5py raises anything on damaged content
        raise DamagedError(f"'{parent.name}/{name}': {reason(error)}") from error
    if link is None:
        raise MissingError(f"{parent.name}/{name}")
    if node is None or (isinstance(node, h5py.Dataset) and (node.external or node.is_virtual)):
        raise EmaError(
            f"'{parent.name}/{name}' leads out of the file, which ema never writes; do not trust it"
        )
    if isinstance(node, h5py.Dataset) and node.shape is not None:
        stated, stored = node.size * node.dtype.itemsize, node.id.get_storage_size()
        if stated > _SMALL_BYTES + _BEST_PACKING * stored:
            raise DamagedError(f"'{parent.name}/{name}': states {stated} bytes where {stored} are stored")
    return node


def _write_text(parent: h5py.Group, name: str, text: str) -> None:
    encoded = _encoded(text)
    if len(encoded) > _LONGEST_ATTRIBUTE or encoded.endswith(b"\0"):  # a fixed length drops zeros at the end
        _write_array(parent, name, np.frombuffer(encoded, dtype=np.uint8))
    else:
        parent.attrs.create(name, np.bytes_(encoded), dtype=_text_dtype(encoded))


def _text_dtype(*texts: bytes) -> Any:
    return h5py.string_dtype("utf-8", max(1, *map(len, texts)))


def _write_array(parent: h5py.Group, name: str, value: np.ndarray[Any, Any]) -> None:
    if (
        value.size == 0 or value.ndim == 0
    ):  # nothing that a checksum could guard, or stored with its description
        parent.create_dataset(name, data=value)
        return
    if value.nbytes < _COMPRESS_FROM_BYTES:
        parent.create_dataset(name, data=value, chunks=value.shape, fletcher32=True)
    elif _is_measured(value):
        parent.create_dataset(name, data=value, chunks=_rows(value.shape), fletcher32=True)
    else:
        parent.create_dataset(name, data=value, chunks=True, compression="lzf", shuffle=True, fletcher32=True)


def _is_measured(value: np.ndarray[Any, Any]) -> bool:
    """True for numbers that are not worth compressing.

    Measured ones gain a twentieth to a tenth and take ten times as long to write and to read; arrays that are mostly
    empty gain all of it.
    """
    if value.dtype.kind not in "fc":
        return False
    some = value.reshape(-1)[:: max(1, value.size // _PROBES)]
    return bool(np.mean(np.isfinite(some) & (some != 0)) > 0.5)


def _rows(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Chunks of a long row each, of a part of it, or of several short ones."""
    chunk: list[int] = []
    most = _ROW_CHUNK
    for size in reversed(shape):
        chunk.insert(0, _share(size, most))
        most = max(1, most // chunk[0])
    return tuple(chunk)


def _share(size: int, most: int) -> int:
    """Length of equal parts of at most `most` each: what is left over in the last one would be stored, too."""
    return -(-size // -(-size // most))


def _write_tuple(parent: h5py.Group, name: str, value: tuple[Any, ...]) -> None:
    if not value:
        parent.create_group(name)
    elif all(isinstance(v, str | Dof) for v in value):
        texts = [_encoded(v) for v in value]
        _write_array(parent, name, np.array(texts, dtype=_text_dtype(*texts)))
    elif all(isinstance(v, bool | int | float | complex) for v in value):
        _write_array(parent, name, np.asarray(value))
    elif _is_plain(type(value[0])) and all(type(v) is type(value[0]) for v in value):
        _write_array(parent, name, _table(value))
    else:
        group = parent.create_group(name)
        for index, item in enumerate(value):
            write(group, str(index), item)


def _table(rows: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    cls = type(rows[0])
    hints = _hints(cls)
    columns: dict[str, list[Any]] = {}
    dtypes: list[tuple[str, Any]] = []
    for f in dataclasses.fields(cls):
        values = [getattr(row, f.name) for row in rows]
        if hints[f.name] in (bool, int, float, complex):
            dtypes.append((f.name, np.dtype(hints[f.name])))
        else:
            values = [_encoded(v) for v in values]
            dtypes.append((f.name, _text_dtype(*values)))
        columns[f.name] = values
    table = np.empty(len(rows), dtype=np.dtype(dtypes))
    for name, values in columns.items():
        table[name] = values
    return table


def _encoded(text: str | Dof) -> bytes:
    return str(text).encode("utf-8", errors="surrogateescape")


def _is_plain(cls: Any) -> bool:
    """True for a dataclass whose fields are all scalars or DOFs, so that it fits a table."""
    if not dataclasses.is_dataclass(cls) or cls is Dof:
        return False
    return all(
        h in _SCALARS or h is Dof or typing.get_origin(h) is typing.Literal for h in _hints(cls).values()
    )


def _hints(cls: Any) -> dict[str, Any]:
    return _resolved_hints(cast(Hashable, cls))


@cache
def _resolved_hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _read_dataclass(node: h5py.Group, cls: type[T], left_out: Mapping[str, Any]) -> T:
    hints = _hints(cls)
    read = [f.name for f in dataclasses.fields(cast(Any, cls)) if f.name not in left_out]
    return cls(**{name: _read(node, name, hints[name]) for name in read}, **left_out)


def _read_tuple(node: h5py.Group | h5py.Dataset, args: tuple[Any, ...]) -> tuple[Any, ...]:
    variadic = len(args) == 2 and args[1] is Ellipsis
    if isinstance(node, h5py.Dataset):
        if node.dtype.names is not None and dataclasses.is_dataclass(args[0]):
            row = cast(Any, args[0])
            hints = _hints(row)
            table, names = node[()], node.dtype.names
            columns = [[_scalar(raw, hints[n]) for raw in table[n].tolist()] for n in names]
            return tuple(
                row(**dict(zip(names, values, strict=True))) for values in zip(*columns, strict=True)
            )
        return tuple(_scalar(v, args[0] if variadic else args[i]) for i, v in enumerate(node[()]))
    size = len(node) + len(node.attrs)
    return tuple(_read(node, str(i), args[0] if variadic else args[i]) for i in range(size))


def _is_none(raw: Any) -> bool:
    return isinstance(raw, str | bytes) and raw in (_NONE, _NONE.encode())


def _scalar(raw: Any, annotation: Any) -> Any:
    if isinstance(raw, bytes):
        raw = raw.decode("utf-8", errors="surrogateescape")
    if annotation is Dof:
        return _dof(str(raw))
    if annotation is Path:
        return Path(str(raw))
    if annotation in _SCALARS:
        return annotation(raw)
    return raw.item() if isinstance(raw, np.generic) else raw


def _dof(text: str) -> Dof:
    try:
        return Dof.parse(text)
    except EmaError as error:
        raise DamagedError(str(error)) from None


def _strip_optional(annotation: Any) -> tuple[Any, bool]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        rest = [a for a in typing.get_args(annotation) if a is not type(None)]
        return (rest[0] if len(rest) == 1 else annotation), len(rest) < len(typing.get_args(annotation))
    return annotation, False


def _escape(key: str) -> str:
    return key.replace("%", "%25").replace("/", "%2F")


def _unescape(key: str) -> str:
    return key.replace("%2F", "/").replace("%25", "%")
