"""Measured modes and FRFs of a run, for all stages that compare them with a model."""

from __future__ import annotations

from ema_pipeline.correlate.measured import MeasuredModes, from_modal_model
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.stages.base import Run


def measured_modes(run: Run) -> dict[str, MeasuredModes]:
    """Measured modes of every configuration."""
    return {
        name: from_modal_model(run.store.load("modal", name, "modal", ModalModel), name)
        for name in run.info.configurations
    }


def measured_frfs(run: Run) -> dict[str, FrfSet]:
    """FRFs of every configuration that has them; none for a table of modes."""
    found = {name: run.store.find("frf", name, "frfs", FrfSet) for name in run.info.configurations}
    return {name: frfs for name, frfs in found.items() if frfs is not None}
