"""FRFs → modes with uncertainties, and the circle fits beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.circle import attach_circles, identify_by_circle
from ema_pipeline.modal.identify import identify
from ema_pipeline.stages.base import Progress, Run

if TYPE_CHECKING:
    from ema_pipeline.pipeline import ModalStageSettings

NAME = "modal"
NEEDS = ("frf",)
PER_CONFIGURATION = True
NEEDS_RIG = False


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the FRFs."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Identify the modes, and look at each of them with circle fits."""
    settings = cast("ModalStageSettings", run.settings[NAME])
    frfs = run.store.load("frf", configuration, "frfs", FrfSet)
    if settings.method == "circle":
        return {"modal": identify_by_circle(frfs, settings.circle)}
    modal = identify(frfs, settings.identify, progress)
    return {"modal": attach_circles(frfs, modal, settings.circle)}
