"""Records and hits of a run, read from its store one at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any, TypeVar, get_type_hints

import h5py

from ema_pipeline import codec
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.ingest.readers.apart import end_helper
from ema_pipeline.ingest.records import Hit, HitSamples, Record, cut_hit
from ema_pipeline.lazy_samples import StoredSamples
from ema_pipeline.run.types import Progress, silent
from ema_pipeline.store import Store

R = TypeVar("R", Record, DrivenRecord)

DRIVEN = "driven"
"""Name of the records of continuous excitation among the results of the stage ``ingest``."""


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
    hits = store.load("hits", configuration, "hits", tuple[Hit, ...])
    with stored_records(store, configuration) as records:
        for i, record in enumerate(records):
            progress(i / len(records), record.file)
            for hit in hits:
                if hit.file == record.file and hit.accepted:
                    yield cut_hit(record, hit)


def driven_records(store: Store, configuration: str) -> tuple[DrivenRecord, ...]:
    """Records of a continuous test of one configuration."""
    return store.load("ingest", configuration, DRIVEN, tuple[DrivenRecord, ...])


def count_driven(store: Store, configuration: str) -> int:
    """Number of records of a continuous test of one configuration; 0 of other tests."""
    with store.group("ingest", configuration) as group:
        return len(codec.member(group, DRIVEN)) if group is not None and DRIVEN in group else 0


def shown(records: Iterator[R], count: int, progress: Progress) -> Iterator[R]:
    """The records, each named as it is read; with the last one ends the process that reads them."""
    try:
        for index, record in enumerate(records):
            progress(index / count, record.file)
            yield record
    finally:
        end_helper()
