"""Modes of all configurations → fitted parameters of the model."""

from __future__ import annotations

from typing import cast

from ema_pipeline.diagnose.types import Ladder
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.level_case import with_sizes_of
from ema_pipeline.stages.modes import measured_modes
from ema_pipeline.store import ALL

NAME = "fit"
NEEDS = ("modal", "ladder")
USES = ("levels",)
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Nothing but the modes, and the ladder to start from."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit all parameters to all configurations at once."""
    from ema_pipeline.fit.map_fit import fit_rig

    settings = cast(FitSettings, run.settings[NAME])
    rig = run.require_model(NAME)
    ladder = run.store.find("ladder", ALL, "ladder", Ladder)
    start = None if ladder is None else {n: p.value for n, p in ladder.rungs[-1].parameters.items()}
    if start:
        rig = with_sizes_of(run, rig, start)
    return {"fit": fit_rig(rig, measured_modes(run), settings, start, progress)}
