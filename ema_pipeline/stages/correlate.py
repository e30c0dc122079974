"""Modes and fitted model → pairs, and where the two part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

from ema_pipeline.correlate.types import Comparison, Pairing
from ema_pipeline.fit.types import FitResult
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.modes import measured_frfs, measured_modes
from ema_pipeline.stages.results import fitted_values
from ema_pipeline.store import ALL

if TYPE_CHECKING:
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
    values = fitted_values(run.store.load("fit", ALL, "fit", FitResult))
    pairings, comparison = correlate(run, run.require_model(NAME), values)
    return {f"pairing {name}": p for name, p in pairings.items()} | {"comparison": comparison}


def correlate(run: Run, rig: Rig, values: Mapping[str, float]) -> tuple[dict[str, Pairing], Comparison]:
    """Pair the measured modes with those of a model, and compare the two."""
    from ema_pipeline.correlate.compare import compare
    from ema_pipeline.correlate.pairing import pair_rig

    settings = cast("CorrelateSettings", run.settings[NAME])
    measured = measured_modes(run)
    pairings = {name: pair_rig(rig, name, values, measured[name], settings.pairing) for name in measured}
    return pairings, compare(rig, values, measured, measured_frfs(run), pairings, settings.compare)
