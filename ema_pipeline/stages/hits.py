"""Records → hits, each with its verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

from ema_pipeline import codec
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.hit_settings import HitSettings
from ema_pipeline.ingest.records import Hit, HitSamples, Record, cut_hit
from ema_pipeline.stages.base import Progress, Run, silent
from ema_pipeline.store import Store

NAME = "hits"
NEEDS = ("ingest",)
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the records."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Find the hits of every record and judge them; every impact point needs one that is good."""
    from ema_pipeline.ingest.quality import hits_of_test

    settings = cast(HitSettings, run.settings[NAME])
    hits = hits_of_test(StoredRecords(run.store, configuration), settings)
    require_good_hits(hits, configuration)
    return {"hits": hits}


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
    """The records of one configuration in the store, read one at a time."""

    def __init__(self, store: Store, configuration: str) -> None:
        self._store = store
        self._path = f"stages/ingest/{configuration}/records"
        with store.reading() as file:
            self._count = len(file[self._path])

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < self._count:
            raise IndexError(index)
        with self._store.reading() as file:
            return codec.read(file[self._path], str(index), Record)


def accepted_hits(store: Store, configuration: str, progress: Progress = silent) -> Iterator[HitSamples]:
    """The good hits of one configuration with their samples, read one record at a time."""
    hits = store.load(NAME, configuration, "hits", tuple[Hit, ...])
    records = StoredRecords(store, configuration)
    for i, record in enumerate(records):
        progress(i / len(records), record.file)
        for hit in hits:
            if hit.file == record.file and hit.accepted:
                yield cut_hit(record, hit)
