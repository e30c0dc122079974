"""Hits, or records of continuous excitation → FRFs and coherence."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet, unknown
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.hits import accepted_hits
from ema_pipeline.stages.ingest import driven_records
from ema_pipeline.store import Store

NAME = "frf"
NEEDS = ("ingest", "hits")
PER_CONFIGURATION = True
NEEDS_RIG = False


def without_coherence(store: Store, configuration: str) -> FrfSet:
    """The FRFs of a configuration, with NaN in place of their coherence, which would take half as much memory."""
    frfs = store.load(NAME, configuration, "frfs", FrfSet, {"coherence": np.zeros(0)})
    return replace(frfs, coherence=unknown(frfs.frf.shape))


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the hits, or the records."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Average the accepted hits of every impact point, or the blocks of continuous records."""
    from ema_pipeline.frf.estimate import estimate_frfs

    settings = cast(FrfSettings, run.settings[NAME])
    if run.info.kind == "continuous":
        from ema_pipeline.frf.driven import estimate_driven_frfs

        return {"frfs": estimate_driven_frfs(driven_records(run.store, configuration), settings)}
    return {"frfs": estimate_frfs(accepted_hits(run.store, configuration, progress), settings)}
