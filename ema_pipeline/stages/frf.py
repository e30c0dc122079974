"""Hits → FRFs and coherence."""

from __future__ import annotations

from typing import cast

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.hits import accepted_hits

NAME = "frf"
NEEDS = ("ingest", "hits")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the hits."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Average the accepted hits of every impact point."""
    from ema_pipeline.frf.estimate import estimate_frfs

    settings = cast(FrfSettings, run.settings[NAME])
    return {"frfs": estimate_frfs(accepted_hits(run.store, configuration, progress), settings)}
