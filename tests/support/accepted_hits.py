"""Records of tests, cut into the hits that the checks accept."""

from __future__ import annotations

from collections.abc import Sequence

from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.records import HitSamples, Record, cut_hit


def accepted(records: Sequence[Record]) -> list[HitSamples]:
    """The accepted hits with their samples, in the order of the records."""
    by_file = {r.file: r for r in records}
    return [cut_hit(by_file[h.file], h) for h in hits_of_test(records) if h.accepted]
