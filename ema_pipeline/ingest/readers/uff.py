"""UFF/UNV data set 58, ASCII and binary (58b), by pyuff.

pyuff reads the headers and the ASCII bodies. Binary bodies are taken straight from the file: pyuff
believes the header about their precision, while its own writer (as others) labels doubles as singles.
The number of points and the bytes between header and end mark leave no doubt about what is stored.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord, clean_unit
from ema_pipeline.ingest.readers.timebase import rate_from_times, whole_rate

NAME = "UFF58"

_MARK = re.compile(rb"^    -1[ ]*\r?$", re.MULTILINE)
_END_OF_BINARY = re.compile(rb"[\r\n]*    -1[ ]*(\r?\n|\r?$)")
_HEADER_LINES = 13  # mark, data set number, five id lines, six records
_TIME_RESPONSE = (0, 1)  # function types: general, time response
_DIRECTIONS = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
_ABSCISSA_ROUNDING = 5.1e-6  # steps are written with six digits (E13.5)
_IEEE = 2
_DOUBLE = 4
_MOST_LATE = 0.5
"""Samples; channels that start further apart are no record of one moment."""


@dataclass(frozen=True)
class _Block:
    number: int
    start: int
    body: int
    stop: int
    binary: bool


def recognise(path: Path, head: bytes) -> bool:
    """True where a ``-1`` line and a data set number open the file."""
    lines = [line.strip() for line in head.lstrip().splitlines()[:2]]
    return len(lines) == 2 and lines[0] == b"-1" and re.match(rb"\d+b?\b", lines[1]) is not None


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read every time history of the file; id line 1 is the channel's name."""
    import pyuff

    data = path.read_bytes()
    blocks = _find_blocks(data)
    limits.check_file(len(data), text=not any(block.binary for block in blocks))
    limits.check_channels(sum(block.number == 58 for block in blocks))
    channels: dict[str, RawChannel] = {}
    rates: list[float] = []
    starts: list[float] = []
    rounding = 0.0
    notes: list[str] = []
    extract = pyuff.datasets.dataset_58._extract58
    for order, block in enumerate(blocks, start=1):
        if block.number != 58:
            continue
        header = extract(data[block.start : block.body], header_only=True)
        name = _name(header)
        if header["func_type"] not in _TIME_RESPONSE or header["ord_data_type"] in (5, 6):
            notes.append(f"data set {order} ('{name}') is no time history and is left out")
            continue
        if name in channels:
            raise EmaError(f"data sets name the channel '{name}' twice; give each its own id line 1")
        samples, times = _body(data, block, header, name, extract, notes)
        step = float(header["abscissa_inc"])
        if times is not None:
            rate, uncertainty = rate_from_times(times)
            rounding = max(rounding, uncertainty)
        else:
            rate = whole_rate(step, _ABSCISSA_ROUNDING) if step > 0 else None
        if rate is not None:
            rates.append(rate)
        starts.append(float(header["abscissa_min"]) if times is None or not times.size else float(times[0]))
        channels[name] = RawChannel(
            samples, clean_unit(header["ordinate_axis_units_lab"]), _dof(header, "rsp"), _dof(header, "ref")
        )
    if not channels:
        raise EmaError("holds no time histories (data set 58 with function type 1); export the time data")
    if rates and max(rates) / min(rates) - 1 > max(1e-4, rounding):
        raise EmaError(
            f"its channels differ in sample rate ({min(rates):.10g} and {max(rates):.10g} Hz); "
            "export them with one rate"
        )
    late = max(starts) - min(starts)
    if rates and late * min(rates) > _MOST_LATE + _ABSCISSA_ROUNDING * max(map(abs, starts)) * min(rates):
        first, last = list(channels)[int(np.argmin(starts))], list(channels)[int(np.argmax(starts))]
        raise EmaError(
            f"its channels start at different times ('{first}' at {min(starts):.6g} s, '{last}' at "
            f"{max(starts):.6g} s); export them from one moment on"
        )
    return RawRecord(channels, rates[0] if rates else None, tuple(notes), rounding)


def _find_blocks(data: bytes) -> list[_Block]:
    """Cut the file into data sets; binary bodies are skipped over, not searched."""
    blocks: list[_Block] = []
    at = 0
    while (mark := _MARK.search(data, at)) is not None:
        start = mark.start()
        body = start
        for _ in range(_HEADER_LINES):
            body = data.find(b"\n", body) + 1
            if body == 0:
                break
        second = data[mark.end() : mark.end() + 90].lstrip(b"\r\n").split(b"\n", 1)[0]
        number = re.match(rb"\s*(\d+)", second)
        binary = re.match(rb"\s*58b", second, re.IGNORECASE) is not None
        if number is None:
            raise EmaError("a '-1' mark is not followed by a data set number; the file is damaged")
        order = len(blocks) + 1
        cut = EmaError(f"is cut short in data set {order}: its end mark is missing; copy or export it again")
        if body == 0 and int(number[1]) == 58:
            raise cut
        if binary:
            header = data[start:body].splitlines()
            stop = _binary_end(data, body, _points(header))
        else:
            end = _MARK.search(data, max(body, mark.end()) if int(number[1]) == 58 else mark.end())
            stop = end.start() if end is not None else -1
        if stop < 0:
            raise cut
        blocks.append(_Block(int(number[1]), start, body, stop, binary))
        after = _END_OF_BINARY.match(data, stop) or _MARK.match(data, stop)
        at = after.end() if after is not None else stop + 6
    return blocks


def _points(header: list[bytes]) -> int:
    return int(header[8].split()[1])


def _binary_end(data: bytes, body: int, points: int) -> int:
    """Where the end mark stands behind one of the possible sizes of a binary body, else searched for."""
    for bytes_per_point in (4, 8, 12, 16, 24):
        if _END_OF_BINARY.match(data, body + points * bytes_per_point):
            return body + points * bytes_per_point
    found = re.compile(rb"    -1[ ]*\r?\n").search(data, body)
    if found is None and data.rstrip().endswith(b"    -1"):
        return data.rstrip().rindex(b"    -1")
    return found.start() if found is not None else -1


def _body(
    data: bytes, block: _Block, header: dict[str, Any], name: str, extract: Any, notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    points = int(header["num_pts"])
    even = int(header["abscissa_spacing"]) != 0
    double = int(header["ord_data_type"]) == _DOUBLE
    if block.binary:
        body = data[block.body : block.stop]
        samples, times = _binary(body, header, points, even, name)
        if even and not double and len(body) >= 8 * points:
            notes.append(f"'{name}' is labelled single precision but stored in double")
    else:
        try:
            full = extract(data[block.start : block.stop], header_only=False)
        except Exception:  # pyuff raises bare Exception
            raise EmaError(f"channel '{name}': its values cannot be read; export the file again") from None
        samples = np.asarray(full["data"], dtype=np.float64)
        times = None if even else np.asarray(full["x"], dtype=np.float64)
    if samples.size != points:
        raise EmaError(
            f"channel '{name}' holds {samples.size} of the {points} samples that its header states; "
            "the file is damaged, copy or export it again"
        )
    return samples, times


def _binary(
    body: bytes, header: dict[str, Any], points: int, even: bool, name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    if int(header["fp_format"]) != _IEEE:
        raise EmaError(f"channel '{name}' is stored in VAX or IBM floats; export it as IEEE 754 or ASCII")
    order = "<" if int(header["byte_ordering"]) == 1 else ">"
    if points == 0:
        return np.empty(0), None
    width, rest = divmod(len(body.rstrip(b"\r\n")) if len(body) % points else len(body), points)
    layouts: dict[tuple[bool, int], list[tuple[str, str]]] = {
        (True, 4): [("y", "f4")],
        (True, 8): [("y", "f8")],
        (False, 8): [("x", "f4"), ("y", "f4")],
        (False, 12): [("x", "f4"), ("y", "f8")],
        (False, 16): [("x", "f8"), ("y", "f8")],
    }
    layout = layouts.get((even, width))
    halved = layout is not None and layout[-1][1] == "f4" and int(header["ord_data_type"]) == _DOUBLE
    if layout is None or rest or halved:
        raise EmaError(
            f"channel '{name}' stores {len(body)} bytes for {points} samples; the file is damaged, "
            "copy or export it again"
        )
    table = np.frombuffer(body, dtype=[(n, order + t) for n, t in layout], count=points)
    return table["y"].astype(np.float64), None if even else table["x"].astype(np.float64)


def _name(header: dict[str, Any]) -> str:
    name = str(header["id1"]).strip()
    if name and name.upper() != "NONE":
        return name
    entity = str(header["rsp_ent_name"]).strip()
    entity = "" if entity.upper() == "NONE" else f"{entity}:"
    return entity + _node(header)


def _node(header: dict[str, Any], end: str = "rsp") -> str:
    direction = int(header[f"{end}_dir"])
    letter = _DIRECTIONS.get(abs(direction), "s")
    return ("-" if direction < 0 else "") + f"{int(header[f'{end}_node'])}.{letter}"


def _dof(header: dict[str, Any], end: str) -> str | None:
    """Node and direction of the response (``rsp``) or the reference (``ref``); None where the file has none."""
    used = int(header[f"{end}_node"]) > 0 and int(header[f"{end}_dir"]) != 0
    return _node(header, end) if used else None
