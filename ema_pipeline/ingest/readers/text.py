"""CSV and text tables: a header row, numbers below it, and whatever a vendor writes above."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers.lines import Lines
from ema_pipeline.ingest.readers.preamble import Preamble, read_preamble
from ema_pipeline.ingest.readers.raw import RawChannel, RawRecord
from ema_pipeline.ingest.readers.timebase import (
    is_index_name,
    is_time_name,
    is_uniform_ramp,
    rate_from_times,
    time_unit_scale,
)
from ema_pipeline.units import find_unit

NAME = "CSV/TXT"

_NUMBER = re.compile(r"[+-]?([0-9]+([.,][0-9]*)?|[.,][0-9]+)([eEdD][+-]?[0-9]+)?")
_NOT_A_NUMBER = {
    "nan",
    "-nan",
    "inf",
    "-inf",
    "+inf",
    "infinity",
    "-infinity",
    "#n/a",
    "#num!",
    "1.#qnan",
    "-1.#ind",
}
_LONGEST_PREAMBLE = 10_000
_LONGEST_FOOTER = 1000
"""Lines; vendors write some dozens."""

_CELLS_AT_ONCE = 2_000_000
"""Cells that are parsed together; one that is odd slows only those beside it."""

_CLOCK = re.compile(r"[0-9]{1,4}[-/.:][0-9]{1,2}[-/.:][0-9]{1,4}.*")


@dataclass(frozen=True)
class Dialect:
    """How a table is written.

    Attributes
    ----------
    delimiter : str
        ``","``, ``";"``, tab, or ``" "`` for any run of blanks.
    decimal : str
        ``"."`` or ``","``.
    """

    delimiter: str
    decimal: str

    def split(self, line: str) -> list[str]:
        """Cells of a line, without quotes and outer blanks."""
        if self.delimiter == " ":
            return line.split()
        return [cell.strip() for cell in next(csv.reader([line], delimiter=self.delimiter), [])]

    def is_number(self, cell: str) -> bool:
        """True for a number in this dialect."""
        return _NUMBER.fullmatch(cell) is not None and (
            "," not in cell if self.decimal == "." else "." not in cell
        )


def recognise(path: Path, head: bytes) -> bool:
    """True for decodable text with a row of numbers somewhere."""
    if not head.startswith((b"\xff\xfe", b"\xfe\xff")) and b"\x00" in head:
        return False
    lines = [line for line in decode(head[: len(head) // 2 * 2]).splitlines() if line.strip()]
    printable = sum(c.isprintable() or c in "\t\r\n\ufeff" for line in lines for c in line)
    if not lines or printable < 0.99 * sum(len(line) for line in lines):
        return False
    return any(_dialect_of(line) is not None or _starts_with_numbers(line) for line in lines)


def _starts_with_numbers(line: str) -> bool:
    """True for a row with texts among its numbers: no table we read, but one worth a better message."""
    cells = re.split(r"[;\t,]", line)
    return len(cells) > 2 and all(_NUMBER.fullmatch(cell.strip()) for cell in cells[:2])


def decode(data: bytes) -> str:
    """Text of a file in UTF-8, UTF-16 (with byte order mark) or Latin-1."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # The first bytes of a file may end within a character; Latin-1 has no such characters.
        if error.reason == "unexpected end of data":
            return data[: error.start].decode("utf-8-sig")
        return data.decode("cp1252", errors="replace")


def read(path: Path, limits: ReadLimits) -> RawRecord:
    """Read the table; a time column or the preamble gives the sample rate."""
    lines = Lines(_utf8(path.read_bytes()))
    dialect, first = _find_table(lines)
    width = _width(lines, first, dialect)
    limits.check_channels(width)
    blank = len(dialect.split(lines[first])) - width
    preamble = read_preamble(list(lines.some(0, first)), dialect.split, width, blank)
    table = _numbers(lines, first, dialect, preamble.names)
    if preamble.samples is not None and table.shape[0] < preamble.samples:
        raise EmaError(
            f"holds {table.shape[0]} of the {preamble.samples} samples that its header states; "
            "the file is cut short, copy or export it again"
        )
    return _channels(table, preamble)


def _utf8(data: bytes) -> bytes:
    return data if data.isascii() else decode(data).encode("utf-8", errors="replace")


def _find_table(lines: Lines) -> tuple[Dialect, int]:
    """Dialect of the table and the index of its first row."""
    # The middle of the file lies in the table unless the preamble is longer than it.
    for probe in (len(lines) // 2, 3 * len(lines) // 4, len(lines) - 2, len(lines) - 1):
        dialect = _dialect_of(lines[probe]) if 0 <= probe < len(lines) else None
        if dialect is None:
            continue
        width = len(_drop_trailing_blank(dialect.split(lines[probe])))
        above = enumerate(lines.some(0, min(probe + 1, _LONGEST_PREAMBLE)))
        first = next((i for i, line in above if _is_table_row(line, dialect, width)), None)
        if first is None:
            continue
        # Rows above that start with a number are table rows with a bad cell: they are reported, not skipped.
        while first > 0 and _starts_like_table(lines[first - 1], dialect, width):
            first -= 1
        return dialect, first
    _check_empty_column(lines)
    raise EmaError("no table of numbers found; export a header row and one column of numbers per channel")


def _check_empty_column(lines: Lines) -> None:
    """Say so where all that the middle of the table lacks is the numbers of a column."""
    middle = lines[len(lines) // 2]
    for delimiter in (";", "\t", ","):
        dialect = Dialect(delimiter, "." if delimiter == "," else ",")
        cells = dialect.split(middle.replace(".", dialect.decimal))
        bad = [i for i, cell in enumerate(cells) if cell == "" or cell.casefold() in _NOT_A_NUMBER]
        if (
            bad
            and len(cells) - len(bad) > 1
            and all(dialect.is_number(cell) for i, cell in enumerate(cells) if i not in bad)
        ):
            shown = f"'{cells[bad[0]]}'" if cells[bad[0]] else "blank"
            raise EmaError(
                f"line {lines.number(len(lines) // 2)}: column {bad[0] + 1} is {shown}, no number; export its "
                "values or leave the column out"
            )


def _dialect_of(line: str) -> Dialect | None:
    """Dialect in which every cell of `line` is a number, None where there is none."""
    for delimiter in (";", "\t", ",", " "):
        if delimiter not in line.strip() and delimiter != " ":
            continue
        for decimal in (".", ","):
            if delimiter == decimal and '"' not in line:
                continue
            dialect = Dialect(delimiter, decimal)
            cells = _drop_trailing_blank(dialect.split(line))
            if cells and all(dialect.is_number(c) for c in _values(cells)) and len(_values(cells)) > 0:
                return dialect
    return None


def _drop_trailing_blank(cells: list[str]) -> list[str]:
    return cells[:-1] if len(cells) > 1 and cells[-1] == "" else cells


def _values(cells: list[str]) -> list[str]:
    """Cells but for a date or clock time in front."""
    return cells[1:] if _CLOCK.fullmatch(cells[0]) else cells


def _is_table_row(line: str, dialect: Dialect, width: int) -> bool:
    cells = _drop_trailing_blank(dialect.split(line))
    return len(cells) == width and all(dialect.is_number(c) for c in _values(cells))


def _starts_like_table(line: str, dialect: Dialect, width: int) -> bool:
    cells = dialect.split(line)
    cells = cells if len(cells) == width else _drop_trailing_blank(cells)
    if len(cells) != width or width == 1:
        return False
    bad = [c for c in cells if not dialect.is_number(c)]
    front = dialect.is_number(cells[0]) or _CLOCK.fullmatch(cells[0]) is not None
    return front and all(c == "" or c.casefold() in _NOT_A_NUMBER or _CLOCK.fullmatch(c) for c in bad)


def _width(lines: Lines, first: int, dialect: Dialect) -> int:
    """Number of columns: what most of the first rows have."""
    widths = Counter(len(_drop_trailing_blank(dialect.split(line))) for line in lines.some(first, first + 20))
    return widths.most_common(1)[0][0]


def _numbers(lines: Lines, first: int, dialect: Dialect, names: tuple[str, ...]) -> NDArray[np.float64]:
    """The table (n_samples, n_columns); a column of dates or clock times becomes NaN."""
    stop = _without_footer(lines, first, dialect)
    clock = _CLOCK.fullmatch(dialect.split(lines[first])[0]) is not None
    table = np.empty((stop - first, len(names)))
    step = max(1, _CELLS_AT_ONCE // len(names))
    for start in range(first, stop, step):
        end = min(start + step, stop)
        block = _fast_numbers(lines, start, end, dialect, len(names), clock)
        if block is None:
            block = _careful_numbers(lines, start, end, dialect, names, clock)
        table[start - first : end - first] = block
    return table


def _without_footer(lines: Lines, first: int, dialect: Dialect) -> int:
    """Index behind the last row: a footer such as "End of data" is none."""
    stop = len(lines)
    while stop > max(first + 1, len(lines) - _LONGEST_FOOTER):
        cells = dialect.split(lines[stop - 1])
        if any(c.isdigit() for c in lines[stop - 1]) or cells[0] == "":
            break
        if any(cell.casefold() in _NOT_A_NUMBER for cell in cells):
            break
        stop -= 1
    return stop


def _fast_numbers(
    lines: Lines, start: int, stop: int, dialect: Dialect, width: int, clock: bool
) -> NDArray[np.float64] | None:
    """Parse in one go; None where anything is odd, so that the careful way can say what."""
    import pandas

    blanks = dialect.delimiter == " "
    if not blanks:
        separators = lines.counts(dialect.delimiter, start, stop)
        if np.ptp(separators) > 0 or separators[0] not in (width - 1, width):
            return None
    elif clock:
        return None
    try:
        frame = pandas.read_csv(
            io.BytesIO(lines.block(start, stop)),
            sep=r"\s+" if blanks else dialect.delimiter,
            decimal=dialect.decimal,
            header=None,
            usecols=None if blanks else range(int(clock), width),
            dtype=np.float64,
            skipinitialspace=True,
        )
    except (ValueError, OverflowError):
        return None
    table = frame.to_numpy(dtype=np.float64)
    if table.shape != (stop - start, width - int(clock)) or not np.all(np.isfinite(table)):
        return None
    return np.insert(table, 0, np.nan, axis=1) if clock else table


def _careful_numbers(
    lines: Lines, start: int, stop: int, dialect: Dialect, names: tuple[str, ...], clock: bool
) -> NDArray[np.float64]:
    """Parse cell by cell and name the first cell that is no number."""
    width = len(names)
    convert = _converter(dialect)
    table = np.empty((stop - start, width))
    for i, line in enumerate(lines.some(start, stop)):
        cells = dialect.split(line)
        cells = cells if len(cells) == width else _drop_trailing_blank(cells)
        if len(cells) != width:
            raise EmaError(
                f"line {lines.number(start + i)} has {len(cells)} cells where the table has {width}; "
                "the file is damaged or cut short, export it again"
            )
        for j, cell in enumerate(cells):
            if j == 0 and clock:
                table[i, j] = np.nan
            elif dialect.is_number(cell):
                table[i, j] = convert(cell)
            else:
                shown = "is blank" if cell == "" else f"'{cell}' is not a number"
                raise EmaError(
                    f"line {lines.number(start + i)}, channel '{names[j]}': {shown}; "
                    "export the record again or leave it out"
                )
    return table


def _converter(dialect: Dialect) -> Callable[[str], float]:
    if dialect.decimal == ",":
        return lambda cell: float(cell.replace(",", ".").replace("d", "e").replace("D", "e"))
    return lambda cell: float(cell.replace("d", "e").replace("D", "e"))


def _channels(table: NDArray[np.float64], preamble: Preamble) -> RawRecord:
    notes = list(preamble.notes)
    rate = preamble.sample_rate_hz
    times: NDArray[np.float64] | None = None
    scale: float | None = 1.0
    channels: dict[str, RawChannel] = {}
    for i, (name, unit) in enumerate(zip(preamble.names, preamble.units, strict=True)):
        samples = np.ascontiguousarray(table[:, i])
        ramp = i == 0 and is_uniform_ramp(samples)
        if i == 0 and np.all(np.isnan(samples)):
            notes.append(f"column '{name}' holds dates or clock times and is left out")
        elif ramp and (is_index_name(name) or (unit is None and _counts(samples))):
            notes.append(f"column '{name}' is a running number and is left out")
        elif times is None and (is_time_name(name) or (ramp and _could_be_time(unit))):
            scale = time_unit_scale(name, unit)
            times = samples * (scale or 1.0)
        elif name in channels:
            raise EmaError(f"two columns have the name '{name}'; rename one in the file")
        else:
            channels[name] = RawChannel(samples, unit)
    tolerance, assumed = 0.0, False
    if times is not None:
        measured, rounding = rate_from_times(times)
        if rate is None:
            rate, tolerance, assumed = measured, rounding, scale is None
        elif measured is not None and abs(measured / rate - 1) > max(1e-3, rounding):
            raise EmaError(
                f"contradicts itself: its header states {rate:.10g} Hz and its time column "
                f"{measured:.10g} Hz; correct the file"
            )
    if not channels:
        raise EmaError("holds no channel beside time; export one column per channel")
    return RawRecord(channels, rate, tuple(notes), tolerance, assumed)


def _counts(samples: NDArray[np.float64]) -> bool:
    return bool(abs(samples[1] - samples[0] - 1.0) < 1e-9)


def _could_be_time(unit: str | None) -> bool:
    """A ramp in the first column is time unless the file gives it another unit."""
    found = find_unit(unit) if unit else None
    return found is None or found.quantity == "time"
