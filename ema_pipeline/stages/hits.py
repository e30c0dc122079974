"""Records → hits, each with its verdicts."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, cast, get_type_hints

import h5py

from ema_pipeline import codec
from ema_pipeline.choices import Choices, HitChoice
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.records import Hit, HitSamples, Record, cut_hit
from ema_pipeline.lazy_samples import StoredSamples
from ema_pipeline.stages.base import Progress, Run, silent
from ema_pipeline.store import Store
from ema_pipeline.verdict import Verdict

NAME = "hits"
NEEDS = ("ingest",)
PER_CONFIGURATION = True
NEEDS_RIG = False

CHOICE = "choice"
"""Name of the verdict on hits that the user excluded."""


def inputs(run: Run, configuration: str) -> str:
    """The records, and the hits that the user excluded."""
    return Choices(run.info.choices.of(configuration).excluded_hits).fingerprint()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Find the hits of every record and judge them; every impact point needs one that is good."""
    from ema_pipeline.ingest.quality import hits_of_test

    settings = cast(HitSettings, run.settings[NAME])
    with stored_records(run.store, configuration) as records:
        hits = hits_of_test(records, settings)
    hits = without_excluded(hits, run.info.choices.of(configuration).excluded_hits)
    require_good_hits(hits, configuration)
    return {"hits": hits}


def without_excluded(hits: tuple[Hit, ...], excluded: Collection[HitChoice]) -> tuple[Hit, ...]:
    """The hits, with a verdict that rejects those that the user excluded."""
    named = {(x.file, x.number) for x in excluded}
    verdict = Verdict(CHOICE, 1.0, 0.0, "1", False, "", "reject_hit", message="excluded by the user")
    return tuple(
        replace(h, verdicts=(*h.verdicts, verdict)) if (h.file, h.number + 1) in named else h for h in hits
    )


def require_good_hits(hits: tuple[Hit, ...], configuration: str) -> None:
    """Make sure that one good hit per impact point is left.

    Raises
    ------
    EmaError
        Names the point without a good hit, and why its hits were rejected.
    """
    good = {h.impact.point for h in hits if h.accepted}
    for hit in hits:
        if hit.impact.point not in good:
            reasons = "; ".join(f"{h.file}: {h.reason}" for h in hits if h.impact.point == hit.impact.point)
            raise EmaError(f"{configuration}: no good hit on {hit.impact.point} ({reasons}); strike it again")


class StoredRecords(Sequence[Record]):
    """Records in an open store, read one at a time; their responses stay there until they are sliced."""

    def __init__(self, group: h5py.Group) -> None:
        self._group = group

    def __len__(self) -> int:
        return len(self._group)

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)
        group, hints = codec.member(self._group, str(index)), get_type_hints(Record)
        small = {
            f.name: codec.read(group, f.name, hints[f.name]) for f in fields(Record) if f.name != "responses"
        }
        return Record(responses=StoredSamples(codec.member(group, "responses")), **small)


@contextlib.contextmanager
def stored_records(store: Store, configuration: str) -> Iterator[StoredRecords]:
    """The records of one configuration in the store."""
    with store.group("ingest", configuration) as group:
        if group is None:
            raise EmaError(f"{store.path}: holds no records of '{configuration}'; run it again")
        yield StoredRecords(codec.member(group, "records"))


def accepted_hits(store: Store, configuration: str, progress: Progress = silent) -> Iterator[HitSamples]:
    """The good hits of one configuration with their samples, read one record at a time."""
    hits = store.load(NAME, configuration, "hits", tuple[Hit, ...])
    with stored_records(store, configuration) as records:
        for i, record in enumerate(records):
            progress(i / len(records), record.file)
            for hit in hits:
                if hit.file == record.file and hit.accepted:
                    yield cut_hit(record, hit)
