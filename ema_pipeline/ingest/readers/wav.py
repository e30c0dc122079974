"""WAV: channels ``ch1``, ``ch2`` …; whole numbers are fractions of the converter's full scale."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.raw import FULL_SCALE, RawChannel, RawRecord

NAME = "WAV"

_SIZE_ELSEWHERE = 0xFFFFFFFF
_MOST_CHUNKS = 10_000


def recognise(path: Path, head: bytes) -> bool:
    """True for RIFF, RIFX and RF64 containers that hold WAVE."""
    return head[:4] in (b"RIFF", b"RIFX", b"RF64") and head[8:12] == b"WAVE"


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read 8 to 32 bit whole numbers (as fractions of full scale) and floats (as they are)."""
    from scipy.io import wavfile

    _check_chunks(path)
    with warnings.catch_warnings():
        # scipy only warns where the file is cut short; unknown chunks, its other warning, do no harm.
        warnings.filterwarnings("error", message=".*(prematurely|incomplete).*")
        rate, data = wavfile.read(str(path))
    table = data if data.ndim == 2 else data[:, np.newaxis]
    limits.check_channels(table.shape[1])
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


def _check_chunks(path: Path) -> None:
    """Refuse a file whose chunks claim more than it has: the reader makes room for what they claim."""
    size, count = path.stat().st_size, 0
    with path.open("rb") as file:
        order = ">" if file.read(12)[:4] == b"RIFX" else "<"
        while len(head := file.read(8)) == 8:
            (length,) = struct.unpack(f"{order}I", head[4:])
            if length == _SIZE_ELSEWHERE:  # RF64 keeps it in its first chunk, and is read to the end
                return
            if file.tell() + length > size:
                raise EmaError(
                    f"states {length} bytes in a chunk where {size - file.tell()} are left: it is cut short; "
                    "copy or export it again"
                )
            file.seek(length + length % 2, 1)
            count += 1
            if count > _MOST_CHUNKS:
                raise EmaError(f"has more than {_MOST_CHUNKS} chunks; export it again")
