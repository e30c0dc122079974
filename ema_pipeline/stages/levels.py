"""Hits, FRFs and modes → what moves with the force of the hits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.hits import accepted_hits
from ema_pipeline.stages.modes import level_study, modes_alone

if TYPE_CHECKING:
    from ema_pipeline.modal.circle.settings import CircleSettings
    from ema_pipeline.pipeline import ModalStageSettings

NAME = "levels"
NEEDS = ("ingest", "hits", "frf", "modal")
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """FRFs and modes of single levels are made with the settings of all of them."""
    return run.settings["frf"].model_dump_json() + run.settings["modal"].model_dump_json()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Follow every mode over the force levels."""
    from ema_pipeline.levels import study_levels

    frfs = run.store.load("frf", configuration, "frfs", FrfSet)
    modal = modes_alone(run, configuration)
    settings = cast(LevelSettings, run.settings[NAME])
    modal_settings = cast("ModalStageSettings", run.settings["modal"])
    study = study_levels(
        lambda: accepted_hits(run.store, configuration),
        frfs,
        modal,
        settings,
        cast(FrfSettings, run.settings["frf"]),
        modal_settings.identify,
        progress,
        run.info.choices.of(configuration),
    )
    return {"study": with_circles(study, modal_settings.circle)}


def with_circles(study: LevelStudy, settings: CircleSettings) -> LevelStudy:
    """The study with circle fits beside the modes of the level that stands for the linear structure."""
    from ema_pipeline.modal.circle import attach_circles

    if study.linear_level is None:
        return study
    levels = list(study.levels)
    level = levels[study.linear_level]
    if level.modal is not None:
        levels[study.linear_level] = replace(level, modal=attach_circles(level.frfs, level.modal, settings))
    return replace(study, levels=tuple(levels))


def level_studies(run: Run) -> dict[str, LevelStudy]:
    """The studies of all configurations that have one; none for a table of modes."""
    found = {name: level_study(run, name) for name in run.info.configurations}
    return {name: study for name, study in found.items() if study is not None}
