"""HDF5: datasets at the root or in groups, with units and sample rate in attributes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.raw import RawRecord, StoredSamples
from ema_pipeline.ingest.readers.timebase import is_time_name

NAME = "HDF5"

LONG = 16_384
"""Vectors of at least so many numbers stay in the file until they are needed."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"


def recognise(path: Path, head: bytes) -> bool:
    """True where the HDF5 signature stands at the start or behind a user block."""
    return any(head[at : at + 8] == SIGNATURE for at in (0, 512, 1024, 2048)) and not head.startswith(
        b"MATLAB"
    )


def read(path: Path) -> RawRecord:
    """Read every numeric dataset of the file."""
    import h5py

    arrays: list[NamedArray] = []
    attributes: dict[str, Any] = {}
    with h5py.File(path, "r") as file:
        attributes.update(file.attrs)

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Group):
                for key, value in item.attrs.items():
                    attributes.setdefault(key, value)
            elif isinstance(item, h5py.Dataset) and item.dtype.names is None and item.shape is not None:
                at = tuple(name.split("/"))
                if _is_long_vector(item) and not is_time_name(at[-1]):
                    arrays.append(NamedArray(at, StoredSamples(path, name, item.size), dict(item.attrs)))
                    return
                values = item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]
                # An h5py string array may come back as a plain str; numpy makes both arrays.
                arrays.append(NamedArray(at, np.asarray(values), dict(item.attrs)))

        file.visititems(visit)
    return assemble(arrays, attributes)


def _is_long_vector(dataset: Any) -> bool:
    return bool(dataset.ndim == 1 and dataset.size >= LONG and dataset.dtype.kind in "fiu")
