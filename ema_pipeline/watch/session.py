"""A test in progress: which points are done, what to strike next, and the test.toml that is completed on the way."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.files import replace_file
from ema_pipeline.ingest.description import RecordDescription, TestDescription, read_channels
from ema_pipeline.ingest.draft import impact_of
from ema_pipeline.ingest.readers import read_raw
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.number_text import plain
from ema_pipeline.plain_text import printable
from ema_pipeline.toml_text import parse_toml, read_toml_text
from ema_pipeline.watch.arrivals import Arrival
from ema_pipeline.watch.judge import JudgedRecord, judge_record


@dataclass(frozen=True)
class Told:
    """What is said of one file.

    Attributes
    ----------
    file : str
    good : bool
        True where at least one hit serves, and no channel is at fault.
    text : str
        One line.
    seconds : float
        From the file's last change to this line.
    record : JudgedRecord or None
        None for a file that could not be read.
    """

    file: str
    good: bool
    text: str
    seconds: float
    record: JudgedRecord | None = None


@dataclass(frozen=True)
class PointState:
    """How far a point is.

    Attributes
    ----------
    point : Dof
    good, wanted : int
        Good hits so far, and those that it needs.
    coherence : dict of str to float
        As in `JudgedRecord`, after the last record on it.
    """

    point: Dof
    good: int
    wanted: int
    coherence: Mapping[str, float]


class Session:
    """One folder.

    Parameters
    ----------
    folder : Path
        With a ``test.toml`` that describes the channels.
    points : sequence of str
        DOFs to strike, in this order; those of the records that test.toml lists where left out.
    wanted : int
        Good hits that a point needs.

    Raises
    ------
    EmaError
        If test.toml is missing or wrong.
    """

    def __init__(self, folder: Path, points: Sequence[str] = (), wanted: int = 3) -> None:
        self.folder, self.wanted = folder, wanted
        self.test: TestDescription = read_channels(folder)
        listed = [r.impact for r in self.test.records if r.impact is not None]
        self.points = tuple(dict.fromkeys([Dof.parse(p) for p in points] or listed))
        self._entries = {r.file: r for r in self.test.records}
        self._judged: dict[str, JudgedRecord] = {}
        self._good: dict[str, list[HitSamples]] = {}
        self._impacts: dict[str, Dof] = {}

    def take(self, arrival: Arrival) -> Told:
        """Judge a file that is complete, and list it in test.toml; in place of what was said of it before."""
        name = arrival.path.name
        self._judged.pop(name, None)
        self._good.pop(name, None)
        self._impacts.pop(name, None)
        try:
            entry = self._entry(arrival.path)
            before = self._samples(entry.impact)
            elsewhere = [
                h for n, hits in self._good.items() if self._impacts[n] != entry.impact for h in hits
            ]
            record, samples = judge_record(self.test, entry, before, elsewhere)
        except EmaError as error:
            return self._told(arrival, False, f"✗ {name}: {_short(str(error), arrival.path)}")
        self._good[name], self._impacts[name], self._judged[name] = samples, record.impact, record
        if name not in self._entries:
            self._list(entry)
        return self._told(arrival, bool(record.good) and not record.faults, self._line(record), record)

    def _told(self, arrival: Arrival, good: bool, text: str, record: JudgedRecord | None = None) -> Told:
        line = printable(" ".join(text.split()))
        return Told(arrival.path.name, good, line, time.time() - arrival.ended, record)

    def _entry(self, path: Path) -> RecordDescription:
        """A record: as test.toml says, else as its name or the file says, else on the point that was asked for."""
        if path.name in self._entries:
            return self._entries[path.name]
        sensors = [c.dof for c in self.test.responses if c.dof is not None]
        impact = impact_of(
            path.stem.split(".", 1)[0], read_raw(path), [*self.points, *sensors], self.test.force.name
        )
        impact = impact or self.next_point
        if impact is None:
            raise EmaError(
                f"{path}: which point was struck? name the file after it (sun_y_1), list it in test.toml, or give "
                "--point"
            )
        return RecordDescription(file=path.name, impact=impact)

    def _list(self, entry: RecordDescription) -> None:
        """Add a record to test.toml."""
        self._entries[entry.file] = entry
        text = read_toml_text(self.test.file).rstrip("\n")
        if entry.file in _listed(text):
            return  # by hand meanwhile, or by another watch on this folder
        replace_file(self.test.file, _with_record(text, entry))

    def _samples(self, impact: Dof | None) -> list[HitSamples]:
        """Good hits on a point so far."""
        return [h for name, hits in self._good.items() if self._impacts[name] == impact for h in hits]

    def states(self) -> tuple[PointState, ...]:
        """How far every point is: those to strike in their order, then those that were struck besides."""
        points = dict.fromkeys([*self.points, *self._impacts.values()])
        coherence = {r.impact: dict(r.coherence) for r in self._judged.values()}
        return tuple(PointState(p, self.count(p), self.wanted, coherence.get(p, {})) for p in points)

    def count(self, point: Dof) -> int:
        """Good hits on a point so far."""
        return len(self._samples(point))

    @property
    def next_point(self) -> Dof | None:
        """The first point that still needs hits; None where all are done or none are known."""
        return next((p for p in self.points if self.count(p) < self.wanted), None)

    @property
    def to_strike(self) -> Dof | None:
        """The point that was struck last while it needs hits, then `next_point`."""
        last = next(reversed(self._impacts.values()), None)
        return last if last is not None and self.count(last) < self.wanted else self.next_point

    @property
    def done(self) -> bool:
        """True where every point has its hits."""
        return bool(self.points) and self.next_point is None

    def _line(self, record: JudgedRecord) -> str:
        """One line on a record: what is wrong with it or how good it is, and what to strike next."""
        count = self.count(record.impact)
        parts = [f"{record.impact} hit {count} of {self.wanted}"]
        if record.good:
            hit = next(h for h in record.hits if h.accepted)
            parts.append(f"{plain(abs(hit.peak_force), 3)} {hit.force_unit}")
        if record.coherence:
            worst = min(record.coherence, key=lambda k: record.coherence[k])
            parts.append(f"coherence {record.coherence[worst]:.3f} or more ({worst})")
        parts += record.faults or record.remarks[:1]
        mark = "✗" if not record.good else "!" if record.faults or record.remarks else "✓"
        return f"{mark} {record.file}: {', '.join(parts)}; {self.advice(record)}"

    def advice(self, record: JudgedRecord) -> str:
        """What to strike next."""
        if self.count(record.impact) < self.wanted:
            return f"strike {record.impact} again"
        if self.done:
            return f"{record.impact} is done, all points are done"
        following = self.next_point
        return f"{record.impact} is done" + (f", next: {following}" if following is not None else "")

    def missing(self) -> list[str]:
        """Records that test.toml lists and that are not there."""
        return [name for name in self._entries if not (self.folder / name).exists()]


def _with_record(text: str, entry: RecordDescription) -> str:
    """A description with one record more: a table at its end, or an item where the records stand in brackets."""
    if re.search(r"^[ \t]*records[ \t]*=", text, re.MULTILINE):
        with suppress(TOMLKitError):
            description = tomlkit.parse(text)
            if isinstance(records := description.get("records"), Array):
                records.append(tomlkit.item({"file": entry.file, "impact": str(entry.impact)}, records))
                return tomlkit.dumps(description).rstrip("\n") + "\n"
    file, impact = json.dumps(entry.file, ensure_ascii=False), json.dumps(str(entry.impact))
    return f"{text}\n\n[[records]]\nfile = {file}\nimpact = {impact}\n"


def _listed(text: str) -> set[object]:
    """Files of the records in a description; none of one that is being edited."""
    with suppress(EmaError):
        records = parse_toml(text, "test.toml").get("records")
        return {r.get("file") for r in records if isinstance(r, dict)} if isinstance(records, list) else set()
    return set()


def _short(text: str, path: Path) -> str:
    """What is wrong with a file, without its name in front."""
    return text.replace(f"{path.parent}/", "").removeprefix(f"{path.name}: ")
