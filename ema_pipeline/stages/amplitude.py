"""Hits of a run at several force levels as observations."""

from __future__ import annotations

from ema_pipeline.levels.linear import structure
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.observations.amplitude import AmplitudeObservations
from ema_pipeline.observations.hit_modes import prepare_hits
from ema_pipeline.stages.base import Run
from ema_pipeline.stages.levels import level_studies
from ema_pipeline.stages.models import mode_observations


def amplitude_observations(run: Run) -> AmplitudeObservations | None:
    """Modes and hits of all configurations; None where none was struck at several levels."""
    hits = []
    for name, study in level_studies(run).items():
        if study.hit_modes is None:
            continue
        modal = structure(run.store.load("modal", name, "modal", ModalModel), study)
        data = prepare_hits(name, study.hit_modes, modal, [level.force_n for level in study.levels])
        if data is not None:
            hits.append(data)
    return AmplitudeObservations(mode_observations(run), hits) if hits else None
