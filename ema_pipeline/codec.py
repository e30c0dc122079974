"""Frozen dataclasses to HDF5 and back, by their type annotations.

The layout is meant to be read with any HDF5 viewer: scalars are attributes, arrays are datasets, nested
dataclasses and dictionaries are groups, a tuple of plain records is a table (compound dataset), a tuple of
anything else is a group with members ``0``, ``1``, … An iterator is written like a tuple, one item at a
time, and `Rows` like an array, one row at a time, so that they need not fit into memory. DOFs are written as
text (``"sun.x"``).
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Hashable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import h5py
import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.rows import Rows

T = TypeVar("T")

_SCALARS = (bool, int, float, complex, str)
_NONE = "__none__"
_COMPRESS_FROM_BYTES = 16_384
_STRING = h5py.string_dtype()


def write(parent: h5py.Group, name: str, value: Any) -> None:
    """Write `value` (see the module's description for what is allowed) as member `name` of `parent`."""
    if value is None:
        parent.attrs[name] = _NONE
    elif isinstance(value, Dof | Path):
        parent.attrs[name] = str(value)
    elif isinstance(value, (*_SCALARS, np.generic)):
        parent.attrs[name] = value
    elif isinstance(value, np.ndarray):
        _write_array(parent, name, value)
    elif isinstance(value, Rows):
        # Not compressed: measured samples gain a twentieth and would take ten times as long to read.
        dataset = parent.create_dataset(name, shape=value.shape, dtype=np.float64)
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


def read(parent: h5py.Group, name: str, annotation: Any) -> Any:
    """Read member `name` of `parent` as the annotated type."""
    annotation, optional = _strip_optional(annotation)
    if name in parent.attrs:
        raw = parent.attrs[name]
        if optional and isinstance(raw, str) and raw == _NONE:
            return None
        return _scalar(raw, annotation)
    if name not in parent:
        raise KeyError(f"{parent.name}/{name}")
    node = parent[name]
    origin = typing.get_origin(annotation)
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        return _read_dataclass(node, annotation)
    if origin is tuple:
        return _read_tuple(node, typing.get_args(annotation))
    if origin is dict:
        _, item = typing.get_args(annotation)
        return {_unescape(k): read(node, k, item) for k in (*node.attrs, *node)}
    return node[()]


def _write_array(parent: h5py.Group, name: str, value: np.ndarray[Any, Any]) -> None:
    large = value.nbytes >= _COMPRESS_FROM_BYTES
    parent.create_dataset(name, data=value, compression="lzf" if large else None, shuffle=large)


def _write_tuple(parent: h5py.Group, name: str, value: tuple[Any, ...]) -> None:
    if not value:
        parent.create_group(name)
    elif all(isinstance(v, str | Dof) for v in value):
        parent.create_dataset(name, data=[str(v) for v in value], dtype=_STRING)
    elif all(isinstance(v, bool | int | float | complex) for v in value):
        parent.create_dataset(name, data=np.asarray(value))
    elif _is_plain(type(value[0])) and all(type(v) is type(value[0]) for v in value):
        parent.create_dataset(name, data=_table(value))
    else:
        group = parent.create_group(name)
        for index, item in enumerate(value):
            write(group, str(index), item)


def _table(rows: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    cls = type(rows[0])
    hints = _hints(cls)
    fields = [f.name for f in dataclasses.fields(cls)]
    dtype = np.dtype([(f, _column_dtype(hints[f])) for f in fields])
    table = np.empty(len(rows), dtype=dtype)
    for f in fields:
        values = [getattr(row, f) for row in rows]
        table[f] = [str(v) if isinstance(v, Dof) else v for v in values]
    return table


def _column_dtype(annotation: Any) -> Any:
    if annotation in (bool, int, float, complex):
        return np.dtype(annotation)
    return _STRING


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


def _read_dataclass(node: h5py.Group, cls: type[T]) -> T:
    hints = _hints(cls)
    return cls(**{f.name: read(node, f.name, hints[f.name]) for f in dataclasses.fields(cast(Any, cls))})


def _read_tuple(node: h5py.Group | h5py.Dataset, args: tuple[Any, ...]) -> tuple[Any, ...]:
    variadic = len(args) == 2 and args[1] is Ellipsis
    if isinstance(node, h5py.Dataset):
        if node.dtype.names is not None and dataclasses.is_dataclass(args[0]):
            row = cast(Any, args[0])
            hints = _hints(row)
            columns = {n: node.fields(n)[()] for n in node.dtype.names}
            return tuple(
                row(**{n: _scalar(columns[n][i], hints[n]) for n in columns}) for i in range(len(node))
            )
        return tuple(_scalar(v, args[0] if variadic else args[i]) for i, v in enumerate(node[()]))
    size = len(node) + len(node.attrs)
    return tuple(read(node, str(i), args[0] if variadic else args[i]) for i in range(size))


def _scalar(raw: Any, annotation: Any) -> Any:
    if isinstance(raw, bytes):
        raw = raw.decode("utf-8")
    if annotation is Dof:
        return Dof.parse(str(raw))
    if annotation is Path:
        return Path(str(raw))
    if annotation in _SCALARS:
        return annotation(raw)
    return raw.item() if isinstance(raw, np.generic) else raw


def _strip_optional(annotation: Any) -> tuple[Any, bool]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        rest = [a for a in typing.get_args(annotation) if a is not type(None)]
        return (rest[0] if len(rest) == 1 else annotation), len(rest) < len(typing.get_args(annotation))
    return annotation, False


def _escape(key: str) -> str:
    return key.replace("%", "%25").replace("/", "%2F")


def _unescape(key: str) -> str:
    return key.replace("%2F", "/").replace("%25", "%")
