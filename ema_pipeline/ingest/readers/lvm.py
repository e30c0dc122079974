"""LabVIEW measurement files (LVM), by lvm_read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord, clean_unit, split_unit
from ema_pipeline.ingest.readers.text import decode
from ema_pipeline.ingest.readers.timebase import rate_from_times, whole_rate

NAME = "LVM"


def recognise(path: Path, head: bytes) -> bool:
    """True for the file's own first words."""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(b"LabVIEW Measurement")


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read the one segment of the file."""
    import lvm_read

    # Decoded here: lvm_read drops what is not UTF-8, which turns m/s² into m/s.
    try:
        content = lvm_read.read_str(decode(path.read_bytes()))
    except ValueError:
        raise EmaError(
            "has no segment of samples under a header: it is damaged or cut short, copy or export it again"
        ) from None
    if content["Segments"] != 1:
        raise EmaError(f"holds {content['Segments']} segments; export each as its own file")
    segment = content[0]
    if "data" not in segment or len(segment["data"]) == 0:
        raise EmaError("holds no samples; export it again")
    table = np.atleast_2d(segment["data"])
    names = [str(n).strip() for n in segment["Channel names"]]
    units = _per_column(segment.get("Y_Unit_Label"), names)
    steps = [s for s in segment.get("Delta_X", []) if isinstance(s, int | float) and s == s]
    if steps and not min(steps) > 0:
        raise EmaError(f"states Delta_X = {min(steps):g} s, which is no time step; correct the file")
    stated = [s for s in segment.get("Samples", []) if isinstance(s, int | float) and s > 0]
    if stated and table.shape[0] > max(stated):
        raise EmaError(
            f"holds {table.shape[0]} rows where its header states {int(max(stated))} samples; "
            "the file is damaged, export it again"
        )
    if stated and table.shape[0] < max(stated):
        raise EmaError(
            f"holds {table.shape[0]} of the {int(max(stated))} samples that its header states; "
            "the file is cut short, copy or export it again"
        )
    channels: dict[str, RawChannel] = {}
    times: list[NDArray[np.float64]] = []
    for i, name in enumerate(names):
        if name == "X_Value":
            if not np.all(np.isnan(table[:, i])):  # a column that was left blank says nothing
                times.append(table[:, i])
        elif name and name != "Comment" and i < table.shape[1]:
            plain, unit = split_unit(name)
            if plain in channels:
                raise EmaError(f"two channels have the name '{plain}'; rename one in the file")
            channels[plain] = RawChannel(np.ascontiguousarray(table[:, i]), unit or clean_unit(units[i]))
    if len(set(steps)) > 1:
        raise EmaError(f"its channels differ in Delta_X ({min(steps):g} and {max(steps):g} s); use one rate")
    rate, tolerance = (whole_rate(steps[0], 1e-6), 0.0) if steps else (None, 0.0)
    for axis in times:
        measured, rounding = rate_from_times(axis)
        if rate is None:
            rate, tolerance = measured, rounding
        elif measured is not None and abs(measured / rate - 1) > max(1e-3, rounding, tolerance):
            source = "its header" if steps else "another time column"
            raise EmaError(
                f"contradicts itself: {source} states {rate:.10g} Hz and its time column X_Value "
                f"{measured:.10g} Hz; correct the file"
            )
    return RawRecord(channels, rate, rate_tolerance=tolerance)


def _per_column(labels: Any, names: list[str]) -> list[Any]:
    """Align labels, of which there is one per channel, with the columns."""
    given = [str(v) for v in labels] if labels is not None else []
    given += [""] * len(names)
    if names and names[0] == "X_Value" and names.count("X_Value") == 1:
        return ["", *given]
    if names.count("X_Value") > 1:
        spread = iter([label for label in given if label] + [""] * len(names))
        return ["" if name == "X_Value" else next(spread) for name in names]
    return given
