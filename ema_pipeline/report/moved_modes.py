"""What another choice of hits or modes has changed: frequencies, damping ratios and errors before and after."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ema_pipeline.number_text import counted, plain
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.tables import Row, Table

SAME = 0.01
"""Relative distance in frequency within which a mode before may be one after."""

LITTLE = 0.05
"""Changes below this, in the mode's standard uncertainty, are counted but not listed."""


@dataclass(frozen=True)
class SeenMode:
    """A mode of a configuration: frequency (Hz) and damping ratio with their standard uncertainties."""

    configuration: str
    number: int
    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float

    @property
    def texts(self) -> tuple[str, str]:
        """Frequency, Hz, and damping ratio, %, as a table shows them: fine enough for a twentieth of their σ."""
        return (
            f"{self.frequency_hz:.{_places(self.frequency_std_hz)}f}",
            f"{100 * self.damping_ratio:.{_places(100 * self.damping_std)}f}",
        )


@dataclass(frozen=True)
class Seen:
    """The modes of a run and its errors.

    Attributes
    ----------
    modes : tuple of SeenMode
    hits : tuple of int
        Hits used, by configuration.
    error, heldout_error : float
        Of the current model; NaN where there is none.
    """

    modes: tuple[SeenMode, ...]
    hits: tuple[int, ...]
    error: float
    heldout_error: float


def seen(results: RunResults) -> Seen:
    """What is held against the results of another choice."""
    modes = tuple(
        SeenMode(c.name, k + 1, m.frequency_hz, m.frequency_std_hz, m.damping_ratio, m.damping_std)
        for c in results.configurations
        if c.modal is not None
        for k, m in enumerate(c.modal.modes)
    )
    hits = tuple(sum(h.accepted for h in c.hits) for c in results.configurations)
    ladder = results.shown_ladder
    if ladder is None or not ladder.rungs:
        error = math.nan if results.comparison is None else results.comparison.error
        return Seen(modes, hits, error, math.nan)
    model = next((r for r in ladder.rungs if r.effects == results.added), ladder.rungs[0])
    return Seen(modes, hits, model.error, model.heldout_error)


def moved_table(before: Seen, after: Seen) -> Table:
    """One row per mode that came, went or moved: frequency and damping before and after, and by how many σ."""
    several = len({m.configuration for m in (*before.modes, *after.modes)}) > 1
    rows = []
    for old, new in _paired(before, after):
        either = new or old
        assert either is not None
        if old is not None and new is not None and _moved(old, new) < LITTLE:
            continue
        then = ("–", "–") if old is None else old.texts
        now = ("–", "–") if new is None else new.texts
        what = "new" if old is None else "gone" if new is None else f"{_moved(old, new):.2g}"
        cells = (str(either.number), then[0], now[0], then[1], now[1], what)
        rows.append(Row(((either.configuration,) if several else ()) + cells, old is None or new is None))
    head = (("",) if several else ()) + (
        "mode",
        "f before, Hz",
        "f after, Hz",
        "ζ before, %",
        "ζ after, %",
        "moved, σ",
    )
    return Table(head, tuple(rows), frozenset(range(1 if several else 0, len(head))))


def still_words(before: Seen, after: Seen) -> str:
    """How many modes stayed where they were, in a sentence; empty where none did."""
    count = sum(o is not None and n is not None and _moved(o, n) < LITTLE for o, n in _paired(before, after))
    whose = "its" if count == 1 else "their"
    return f"{counted(count, 'mode')} stayed within a twentieth of {whose} uncertainty." if count else ""


def error_words(before: Seen, after: Seen) -> str:
    """Hits used and errors before and after, in a sentence; empty where there is neither."""
    parts = []
    if sum(before.hits) != sum(after.hits):
        parts.append(f"hits used {sum(before.hits)} → {sum(after.hits)}")
    if len(before.modes) != len(after.modes):
        parts.append(f"modes {len(before.modes)} → {len(after.modes)}")
    if math.isfinite(after.error):
        parts.append(f"error of the model {plain(before.error, 4)} → {plain(after.error, 4)}")
    if math.isfinite(after.heldout_error):
        parts.append(f"held out {plain(before.heldout_error, 4)} → {plain(after.heldout_error, 4)}")
    text = ", ".join(parts)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _places(std: float) -> int:
    """Decimal places that show changes far below a standard uncertainty."""
    return 4 if not std > 0 else min(max(2 - math.floor(math.log10(std)), 0), 6)


def _moved(old: SeenMode, new: SeenMode) -> float:
    """The larger change of frequency and damping, in standard uncertainties of the mode before."""
    frequency = abs(new.frequency_hz - old.frequency_hz) / max(old.frequency_std_hz, 1e-12 * old.frequency_hz)
    damping = abs(new.damping_ratio - old.damping_ratio) / max(old.damping_std, 1e-12)
    return max(frequency, damping)


def _paired(before: Seen, after: Seen) -> list[tuple[SeenMode | None, SeenMode | None]]:
    """Modes before with those after, the nearest first; what has no partner stands alone. By frequency."""
    near = sorted(
        (abs(o.frequency_hz - n.frequency_hz), i, j)
        for i, o in enumerate(before.modes)
        for j, n in enumerate(after.modes)
        if o.configuration == n.configuration
        and abs(o.frequency_hz - n.frequency_hz) <= SAME * o.frequency_hz
    )
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in near:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    found: list[tuple[SeenMode | None, SeenMode | None]] = [
        (o, after.modes[partner[i]] if i in partner else None) for i, o in enumerate(before.modes)
    ]
    found += [(None, n) for j, n in enumerate(after.modes) if j not in taken]
    names = list(dict.fromkeys(m.configuration for m in (*before.modes, *after.modes)))

    def place(pair: tuple[SeenMode | None, SeenMode | None]) -> tuple[int, float]:
        either = pair[1] or pair[0]
        assert either is not None
        return names.index(either.configuration), either.frequency_hz

    return sorted(found, key=place)
