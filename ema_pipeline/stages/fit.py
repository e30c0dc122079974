"""Modes of all configurations → fitted parameters of the model."""

from __future__ import annotations

from typing import cast

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.fit.map_fit import fit_rig
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.stages.base import Progress, Run

NAME = "fit"
NEEDS = ("modal",)
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the modes."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit all parameters to all configurations at once."""
    settings = cast(FitSettings, run.settings[NAME])
    rig = run.require_rig(NAME)
    return {"fit": fit_rig(rig, measured_modes(run), settings, progress=progress)}


def measured_modes(run: Run) -> dict[str, MeasuredModes]:
    """Measured modes of every configuration."""
    return {
        name: from_modal_model(run.store.load("modal", name, "modal", ModalModel), name)
        for name in run.info.configurations
    }
