"""Modes and fitted model → pairs, and where the two part."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.fit.types import FitResult
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.modes import measured_frfs, measured_modes
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    from ema_pipeline.fit.parameters import FittedModes
    from ema_pipeline.pipeline import CorrelateSettings

NAME = "correlate"
NEEDS = ("frf", "modal", "fit")
USES = ("levels",)
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Nothing but earlier results."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Pair the modes at the fitted parameters, then compare modes, shapes and FRFs."""
    from ema_pipeline.stages.models import fitted_modes

    fitted = fitted_modes(run, run.store.load("fit", ALL, "fit", FitResult))
    pairings, comparison = correlate(run, run.require_model(NAME), fitted)
    return {f"pairing {name}": p for name, p in pairings.items()} | {"comparison": comparison}


def correlate(run: Run, rig: Rig, fitted: FittedModes) -> tuple[dict[str, Pairing], Comparison]:
    """Pair the measured modes with those of a fitted model, and compare the two."""
    from ema_pipeline.correlate.compare import compare
    from ema_pipeline.correlate.pairing import pair_system

    settings = cast("CorrelateSettings", run.settings[NAME])
    measured = measured_modes(run)
    pairings = {
        name: pair_system(rig, fitted.system(name), modes, settings.pairing)
        for name, modes in measured.items()
    }
    return pairings, compare(fitted, measured, measured_frfs(run), pairings, settings.compare)
