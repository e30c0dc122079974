"""A reproduced source: tables of printed numbers beside ours, and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure


@dataclass(frozen=True)
class Entry:
    """One number: what the source prints (None where it prints nothing), what comes out here, and why they
    differ where that is known."""

    item: str
    printed: float | None
    value: float
    unit: str
    remark: str = ""

    @property
    def difference(self) -> float | None:
        """(value - printed)/|printed|; None where nothing is printed."""
        if self.printed is None or self.printed == 0.0:
            return None
        return (self.value - self.printed) / abs(self.printed)


@dataclass(frozen=True)
class Table:
    """A table: its title, where the source has it, its entries, remarks below it, and what `printed` is
    where it comes from elsewhere."""

    title: str
    source: str
    entries: tuple[Entry, ...]
    remarks: tuple[str, ...] = ()
    reference: str = "printed"


@dataclass(frozen=True)
class Reproduction:
    """A source computed anew.

    Attributes
    ----------
    name, title, source : str
    tables : tuple of Table
    figures : dict of str to Figure
        By file name without suffix.
    captions : dict of str to str
        Captions of the figures.
    """

    name: str
    title: str
    source: str
    tables: tuple[Table, ...]
    figures: Mapping[str, Figure]
    captions: Mapping[str, str]
