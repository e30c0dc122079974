"""Hits, FRFs and modes → what moves with the force of the hits."""

from __future__ import annotations

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Hit
from ema_pipeline.run.measured import modes_alone, without_coherence
from ema_pipeline.run.records import accepted_hits
from ema_pipeline.run.types import Progress, Run

NAME = "levels"
NEEDS = ("ingest", "hits", "frf", "modal")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """FRFs and modes of single levels are made with the settings of all of them."""
    return run.settings.frf.model_dump_json() + run.settings.modal.model_dump_json()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Follow every mode over the force levels."""
    from ema_pipeline.levels.study import levels_of, study_levels, with_circles

    hits = [h for h in run.store.load("hits", configuration, "hits", tuple[Hit, ...]) if h.accepted]
    if levels_of(hits, run.settings.levels).any():
        frfs = run.store.load("frf", configuration, "frfs", FrfSet)
    else:
        frfs = without_coherence(run, configuration)
    modal = modes_alone(run, configuration)
    study = study_levels(
        lambda: accepted_hits(run.store, configuration),
        frfs,
        modal,
        run.settings.levels,
        run.settings.frf,
        run.settings.modal.identify,
        progress,
        run.info.choices.of(configuration),
        run.settings.processes,
    )
    return {"study": with_circles(study, run.settings.modal.circle)}
