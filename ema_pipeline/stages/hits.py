"""Records → hits, each with its verdicts."""

from __future__ import annotations

from ema_pipeline.choices import Choices
from ema_pipeline.ingest.chosen import require_good_hits, without_excluded
from ema_pipeline.run.records import stored_records
from ema_pipeline.run.types import Progress, Run

NAME = "hits"
NEEDS = ("ingest",)
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """The records, and the hits that the user excluded."""
    return Choices(run.info.choices.of(configuration).excluded_hits).fingerprint()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Find the hits of every record and judge them; every impact point needs one that is good."""
    from ema_pipeline.ingest.hit_checks import hits_of_test

    with stored_records(run.store, configuration) as records:
        hits = hits_of_test(records, run.settings.hits)
    hits = without_excluded(hits, run.info.choices.of(configuration).excluded_hits)
    require_good_hits(hits, configuration)
    return {"hits": hits}
