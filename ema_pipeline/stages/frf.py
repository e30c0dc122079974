"""What was recorded → FRFs and coherence."""

from __future__ import annotations

from ema_pipeline.kinds import kind_of
from ema_pipeline.run.types import Progress, Run

NAME = "frf"
NEEDS = ("ingest", "hits")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the hits, or the records."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Average the accepted hits of every impact point, or the blocks of continuous records."""
    return {"frfs": kind_of(run.info).frfs(run, configuration, progress)}
