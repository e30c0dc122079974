"""MATLAB files: version 5 (scipy) and 7.3 (HDF5 in disguise)."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.raw import RawRecord

NAME = "MAT"

_NUMERIC = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}


def recognise(path: Path, head: bytes) -> bool:
    """True for the text that MATLAB writes at the start of both versions."""
    return head.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"))


def read(path: Path) -> RawRecord:
    """Read every numeric variable, and the fields of structs one level down."""
    with path.open("rb") as file:
        newer = file.read(10) == b"MATLAB 7.3"
    return assemble(_with_label_units(_read_73(path) if newer else _read_5(path)))


def _read_5(path: Path) -> list[NamedArray]:
    from scipy.io import loadmat

    arrays: list[NamedArray] = []
    for name, value in loadmat(str(path), struct_as_record=False).items():
        if name.startswith("__"):
            continue
        values = np.asarray(value)
        struct: Any = values.ravel()[0] if values.dtype == object and values.size == 1 else None
        if hasattr(struct, "_fieldnames"):
            for field in struct._fieldnames:
                arrays.append(NamedArray((name, field), np.asarray(getattr(struct, field))))
        else:
            arrays.append(NamedArray((name,), values))
    return arrays


def _read_73(path: Path) -> list[NamedArray]:
    import h5py

    arrays: list[NamedArray] = []
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if name.startswith("#") or not isinstance(item, h5py.Dataset):
                return
            kind = item.attrs.get("MATLAB_class", b"double")
            kind = kind.decode() if isinstance(kind, bytes) else str(kind)
            steps = tuple(name.split("/"))
            if kind in _NUMERIC and "MATLAB_empty" not in item.attrs and item.dtype.kind in "fiu":
                arrays.append(NamedArray(steps, item[()].T))
            elif kind == "char" and item.dtype.kind == "u":
                arrays.append(NamedArray(steps, np.asarray(_characters(item))))
            elif kind == "cell" and item.dtype == h5py.ref_dtype:
                texts = [_characters(file[reference]) for reference in np.ravel(item[()])]
                arrays.append(NamedArray(steps, np.asarray(texts)))

        file.visititems(visit)
    return arrays


def _characters(dataset: Any) -> str:
    return "".join(chr(int(code)) for code in np.ravel(dataset[()]) if dataset.dtype.kind == "u")


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
