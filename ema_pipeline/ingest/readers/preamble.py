"""What stands above a table of numbers: names, units, sample rate."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from ema_pipeline.ingest.readers.raw import clean_unit, split_unit
from ema_pipeline.units import find_unit

_NAME_LABELS = {"ch no.", "ch no", "ch name", "channel", "channels", "channel name", "channel names", "name"}
_NAME_LABELS |= {"names", "signal", "signals", "kanal", "kanalname", "label", "labels"}
_UNIT_LABELS = {"unit", "units", "einheit", "einheiten", "channel units", "y_unit_label"}
_LABEL = r"^[#%;\"'\s]*"
_VALUE = r"[^0-9+.-]*([0-9]+(?:[.,][0-9]+)?(?:[eE][+-]?[0-9]+)?)"
_RATE = re.compile(
    _LABEL + r"(?:sampl\w*[ _]*(?:rate|freq\w*)|abtastrate|abtastfrequenz|fs\b)" + _VALUE, re.I
)
_STEP = re.compile(
    _LABEL + r"(?:sampl\w*[ _]*(?:interval|period)|abtastintervall|delta[ _]?t\b|dt\b)" + _VALUE, re.I
)
_COUNT = re.compile(_LABEL + r"(?:data nos/ch|samples per channel|number of samples)" + _VALUE, re.I)


@dataclass(frozen=True)
class Preamble:
    """What was found above the table.

    Attributes
    ----------
    names : tuple of str
        One per column.
    units : tuple of (str or None)
        One per column.
    sample_rate_hz : float or None
    samples : int or None
        Number of samples that the file promises.
    notes : tuple of str
    """

    names: tuple[str, ...]
    units: tuple[str | None, ...]
    sample_rate_hz: float | None = None
    samples: int | None = None
    notes: tuple[str, ...] = ()


def read_preamble(
    lines: list[str], split: Callable[[str], list[str]], width: int, blank_columns: int = 0
) -> Preamble:
    """Read the lines above a table of `width` columns, behind which `blank_columns` hold nothing.

    Labelled rows count first (``Unit,…``, ``CH No.,…`` as Kyowa writes them), else the row right above the
    table, with a row of units in between.
    """
    rows = [
        cells for cells in (_cells(line, split, width, blank_columns) for line in lines) if cells is not None
    ]
    notes: tuple[str, ...] = ()
    units = _labelled(rows, _UNIT_LABELS)
    names = _labelled(rows, _NAME_LABELS)
    if names is not None and len({n for n in names[1:] if n}) < width - 1:
        names = None
    unlabelled = [r for r in rows if r[0].casefold() not in _UNIT_LABELS]
    if names is None and unlabelled:
        if units is None and len(unlabelled) > 1 and _all_units(unlabelled[-1]):
            units = unlabelled.pop()
        if any(cell for cell in unlabelled[-1]):
            names = unlabelled[-1]
    if names is None:
        names = [f"column{i + 1}" for i in range(width)]
        notes = ("no header row: columns are named column1, column2 …",)
    pairs = [split_unit(name or f"column{i + 1}") for i, name in enumerate(names)]
    return Preamble(
        names=tuple(name for name, _ in pairs),
        units=tuple(
            clean_unit(u) if u else (clean_unit(_bare(units[i])) if units is not None else None)
            for i, (_, u) in enumerate(pairs)
        ),
        sample_rate_hz=_rate(lines),
        samples=_count(lines),
        notes=notes,
    )


def _cells(line: str, split: Callable[[str], list[str]], width: int, blank_columns: int) -> list[str] | None:
    """Cells of a header row without a leading comment sign; None where it does not fit the table."""
    plain = re.sub(r"^\s*[#%]+\s*", "", line).strip(" ")
    cells = split(plain)
    if len(cells) == width + 1 and (cells[-1] == "" or blank_columns):
        cells = cells[:-1]
    if len(cells) == width:
        return cells
    if split("a b") != ["a", "b"]:
        return None
    # Names in blank-separated headers may hold blanks: two or more then part them, or brackets do.
    parted = re.split(r"\s{2,}|\t", plain)
    if len(parted) != width:
        parted = re.findall(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?", plain)
    return parted if len(parted) == width else None


def _labelled(rows: list[list[str]], labels: set[str]) -> list[str] | None:
    """The last row that a label opens and that says something, e.g. ``CH No.,CH2,CH3``."""
    found = [r for r in rows if r[0].casefold() in labels and len(r) > 1 and all(r[1:])]
    return found[0] if found else None


def _all_units(cells: list[str]) -> bool:
    filled = [c for c in cells if c and c != "-"]
    return bool(filled) and all(find_unit(c) is not None for c in filled)


def _bare(text: str) -> str:
    return text.strip().strip("[]()").strip()


def _first_number(pattern: re.Pattern[str], lines: list[str]) -> tuple[float, str] | None:
    for line in lines:
        match = pattern.match(line)
        if match:
            return float(match[1].replace(",", ".")), line
    return None


def _rate(lines: list[str]) -> float | None:
    found = _first_number(_RATE, lines)
    if found is not None and found[0] > 0:
        return found[0] * (1000.0 if re.search(r"khz", found[1], re.IGNORECASE) else 1.0)
    step = _first_number(_STEP, lines)
    if step is not None and step[0] > 0:
        milli = re.search(r"[\s(\[]ms\b", step[1]) is not None
        return 1.0 / (step[0] * (1e-3 if milli else 1.0))
    return None


def _count(lines: list[str]) -> int | None:
    found = _first_number(_COUNT, lines)
    return int(found[0]) if found is not None else None
