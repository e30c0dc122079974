"""TDMS (National Instruments), by npTDMS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.readers.arrays import NamedArray, assemble
from ema_pipeline.ingest.readers.raw import RawRecord

NAME = "TDMS"


def recognise(path: Path, head: bytes) -> bool:
    """True where the first segment starts with its tag."""
    return head.startswith(b"TDSm")


def read(path: Path) -> RawRecord:
    """Read every channel that holds numbers, scaled as its properties say."""
    import logging

    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # its warnings would land on the user's screen; we raise instead
    with TdmsFile.open(str(path)) as file:
        if file.file_status.incomplete_final_segment:
            raise EmaError("is cut short: its last segment is incomplete; copy or export it again")
        arrays = [
            NamedArray((group.name, channel.name), np.asarray(channel[:]), dict(channel.properties))
            for group in file.groups()
            for channel in group.channels()
            if len(channel)
        ]
        return assemble(arrays, {**file.properties, **_group_properties(file)})


def _group_properties(file: object) -> dict[str, object]:
    merged: dict[str, object] = {}
    for group in file.groups():  # type: ignore[attr-defined]
        merged.update(group.properties)
    return merged
