"""Measured modes and FRFs of a run, for all stages that compare them with a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.frf.types import FrfSet, unknown
from ema_pipeline.levels.linear import structure, structure_frfs
from ema_pipeline.levels.types import LevelStudy
from ema_pipeline.modal.types import NO_SYNTHESIS, ModalModel
from ema_pipeline.run.types import Run


def modes_of_structure(run: Run, configuration: str) -> ModalModel:
    """The modes of a configuration as a linear structure.

    Those of all hits, or those of one force level where the answer depends on the level.
    """
    return structure(modes_alone(run, configuration), level_study(run, configuration))


def modes_alone(run: Run, configuration: str) -> ModalModel:
    """The modes of a configuration without the FRFs that they give."""
    return run.store.load("modal", configuration, "modal", ModalModel, {"synthesis": NO_SYNTHESIS})


def measured_modes(run: Run) -> dict[str, MeasuredModes]:
    """Measured modes of every configuration, as a linear structure."""
    at = ("measured modes", modes_key(run))
    if at not in run.memory:
        run.memory[at] = {
            name: from_modal_model(modes_of_structure(run, name), name) for name in run.info.configurations
        }
    return dict(run.memory[at])


def modes_key(run: Run) -> str:
    """Key of the measured modes: an equal key means the same data."""
    keys = [run.store.key(stage, c) for stage in ("modal", "levels") for c in run.info.configurations]
    return " ".join(keys)


def measured_frfs(run: Run) -> dict[str, FrfSet]:
    """FRFs that the modes belong to, of every configuration that has them; none for a table of modes."""
    found = {name: run.store.find("frf", name, "frfs", FrfSet) for name in run.info.configurations}
    return {
        name: structure_frfs(frfs, level_study(run, name)) for name, frfs in found.items() if frfs is not None
    }


def without_coherence(run: Run, configuration: str) -> FrfSet:
    """The FRFs of a configuration, with NaN in place of their coherence, which would take half as much memory."""
    frfs = run.store.load("frf", configuration, "frfs", FrfSet, {"coherence": np.zeros(0)})
    return replace(frfs, coherence=unknown(frfs.frf.shape))


def level_study(run: Run, configuration: str) -> LevelStudy | None:
    """What moves with the force of the hits; None where that was not looked at."""
    return run.store.find("levels", configuration, "study", LevelStudy)


def level_studies(run: Run) -> dict[str, LevelStudy]:
    """The studies of all configurations that have one; none for a table of modes."""
    found = {name: level_study(run, name) for name in run.info.configurations}
    return {name: study for name, study in found.items() if study is not None}
