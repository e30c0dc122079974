"""TDMS (National Instruments), by npTDMS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.raw import RawRecord

NAME = "TDMS"

APART = "tdms"
"""Read in a process apart: a damaged file can keep its reader busy for ever."""


def recognise(path: Path, head: bytes) -> bool:
    """True where the first segment starts with its tag."""
    return head.startswith(b"TDSm")


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read every channel that holds numbers, scaled as its properties say."""
    import logging

    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # its warnings would land on the user's screen; we raise instead
    # Opened here: by its path, the library would believe an index file beside it, of whatever recording that is.
    with path.open("rb") as stored, TdmsFile.open(stored) as file:
        if file.file_status.incomplete_final_segment:
            raise EmaError("is cut short: its last segment is incomplete; copy or export it again")
        channels = [c for group in file.groups() for c in group.channels() if len(c) and _is_numeric(c)]
        limits.check_channels(len(channels))
        stated = sum(len(c) * c.data_type.size for c in channels)
        if stated > path.stat().st_size:  # nothing in it is packed
            raise EmaError(
                f"states {stated} bytes of samples, more than the whole file has; copy or export it again"
            )
        arrays = [NamedArray((c.group_name, c.name), np.asarray(c[:]), dict(c.properties)) for c in channels]
        groups = {f"group '{group.name}'": dict(group.properties) for group in file.groups()}
        return assemble(arrays, {"file properties": dict(file.properties), **groups}, limits)


def _is_numeric(channel: Any) -> bool:
    kind = getattr(channel.data_type, "nptype", None)
    return kind is not None and np.dtype(kind).kind in "fiuc" and bool(channel.data_type.size)
