"""Hammer tests: hits with their force, FRFs, and modes that may move from hit to hit."""

from __future__ import annotations

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.kinds import by_modes
from ema_pipeline.kinds.base import Kind, Results
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.run.measured import without_coherence
from ema_pipeline.run.records import accepted_hits, shown
from ema_pipeline.run.sources import tests_of
from ema_pipeline.run.types import Progress, Run


def _read(run: Run, configuration: str, progress: Progress) -> Results:
    from ema_pipeline.ingest.load import load_records

    tests = tests_of(run, configuration)
    records = load_records(*tests, limits=run.settings.ingest)
    return {"records": shown(records, sum(len(t.records) for t in tests), progress)}


def _frfs(run: Run, configuration: str, progress: Progress) -> FrfSet:
    from ema_pipeline.frf.estimate import estimate_frfs

    return estimate_frfs(accepted_hits(run.store, configuration, progress), run.settings.frf)


def _modes(run: Run, configuration: str, progress: Progress) -> ModalModel:
    from ema_pipeline.modal.circle import attach_circles
    from ema_pipeline.modal.combine_estimates import pooled
    from ema_pipeline.modal.hit_to_hit import identify_hits

    settings = run.settings.modal

    def load_frfs() -> FrfSet:
        return without_coherence(run, configuration)

    if settings.method == "circle":
        from ema_pipeline.modal.circle import identify_by_circle

        return identify_by_circle(load_frfs(), settings.circle)
    found = identify_hits(
        lambda: accepted_hits(run.store, configuration),
        load_frfs,
        run.settings.frf,
        settings.identify,
        progress,
        run.info.choices.of(configuration).included_modes,
    )
    modal = attach_circles(found.frfs, found.modal, settings.circle)
    return pooled(modal, found.alignment, found.frfs.record_s, found.frfs.response_decay_rad_s)


KIND = Kind(
    name="hammer",
    words="hits of a hammer",
    measures=("ingest", "hits", "frf", "modal", "levels"),
    judge=by_modes.judge,
    read=_read,
    frfs=_frfs,
    modes=_modes,
)
