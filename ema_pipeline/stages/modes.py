"""Measured modes of a run, for all stages that compare them with a model."""

from __future__ import annotations

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.stages.base import Run


def measured_modes(run: Run) -> dict[str, MeasuredModes]:
    """Measured modes of every configuration."""
    return {
        name: from_modal_model(run.store.load("modal", name, "modal", ModalModel), name)
        for name in run.info.configurations
    }
