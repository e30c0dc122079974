"""The effects that the user added → error fitted and held out, rung by rung."""

from __future__ import annotations

from typing import cast

from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.errors import EmaError
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.modes import measured_modes

NAME = "ladder"
NEEDS = ("modal",)
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Measured with the settings of the diagnosis; the user's own effects take part."""
    return run.settings["diagnose"].model_dump_json() + run.effect_hashes()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit the base model and every rung above it; without added effects there is no ladder to climb."""
    from ema_pipeline.diagnose import make_ladder

    if not run.info.effects:
        return {}
    if run.rig is None:
        raise EmaError(f"{run.store.folder}: a ladder needs a model; run again with --rig")
    settings = cast(DiagnoseSettings, run.settings["diagnose"])
    return {
        "ladder": make_ladder(run.rig, measured_modes(run), run.info.effects, settings, run.library, progress)
    }
