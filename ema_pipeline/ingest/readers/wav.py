"""WAV: channels ``ch1``, ``ch2`` …; whole numbers are fractions of the converter's full scale."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ema_pipeline.ingest.readers.raw import FULL_SCALE, RawChannel, RawRecord

NAME = "WAV"


def recognise(path: Path, head: bytes) -> bool:
    """True for RIFF, RIFX and RF64 containers that hold WAVE."""
    return head[:4] in (b"RIFF", b"RIFX", b"RF64") and head[8:12] == b"WAVE"


def read(path: Path) -> RawRecord:
    """Read 8 to 32 bit whole numbers (as fractions of full scale) and floats (as they are)."""
    from scipy.io import wavfile

    with warnings.catch_warnings():
        # scipy only warns where the file is cut short; unknown chunks, its other warning, do no harm.
        warnings.filterwarnings("error", message=".*(prematurely|incomplete).*")
        rate, data = wavfile.read(str(path))
    table = data if data.ndim == 2 else data[:, np.newaxis]
    if table.dtype.kind == "f":
        numbers, unit = table.astype(np.float64), None
    elif table.dtype == np.uint8:
        numbers, unit = (table.astype(np.float64) - 128.0) / 128.0, FULL_SCALE
    else:
        # 24 bit samples arrive in the upper three bytes of an int32, so one rule fits all widths.
        numbers, unit = table / float(2 ** (8 * table.dtype.itemsize - 1)), FULL_SCALE
    channels = {
        f"ch{i + 1}": RawChannel(np.ascontiguousarray(numbers[:, i]), unit) for i in range(numbers.shape[1])
    }
    notes = ("whole-number WAV: samples are fractions of full scale",) if unit else ()
    return RawRecord(channels=channels, sample_rate_hz=float(rate), notes=notes)
