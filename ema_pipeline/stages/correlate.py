"""Modes and fitted model → pairs, and where the two differ."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ema_pipeline.check_result import CheckResult
from ema_pipeline.diagnose.types import Diagnosis
from ema_pipeline.fit.types import FitResult
from ema_pipeline.run.measured import measured_frfs
from ema_pipeline.run.types import Progress, Run
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    from ema_pipeline.fit.parameters import FittedModes

NAME = "correlate"
NEEDS = ("frf", "modal", "fit")
USES = ("levels", "diagnose")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Nothing but earlier results."""
    return ""


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Pair the modes at the fitted parameters, then compare modes, shapes and FRFs; so for the base model's modes."""
    from ema_pipeline.fit.parameters import restored
    from ema_pipeline.observations.fitting import Model
    from ema_pipeline.run.models import base_unknowns, correlate, known_model, mode_observations

    fit, model = run.store.load("fit", ALL, "fit", FitResult), known_model(run)
    observations = mode_observations(run).suited(model.effects)
    fitted = restored(observations, model, fit)
    pairings, comparison = correlate(run, run.require_model(NAME), fitted)
    results: dict[str, object] = {f"pairing {name}": p for name, p in pairings.items()}
    if fitted.fit.model.effects and run.rig is not None:
        base = restored(observations, Model(), replace(fit, unknowns=base_unknowns(run)))
        results["comparison_base"] = correlate(run, run.rig, base, with_frfs=False)[1]
    return results | {"comparison": comparison, "sensitivities": _suspected(run, fitted)}


def _suspected(run: Run, fitted: FittedModes) -> tuple[CheckResult, ...]:
    """Sensitivities that neither the nominal nor the fitted model can explain, nor the one with what is missing."""
    from ema_pipeline.fit.channel_faults import suspected_sensitivities

    model, frfs = run.require_model(NAME), measured_frfs(run)
    fits = [fitted, *_diagnosed(run)]
    systems = {name: (model.system(name), *(f.system(name) for f in fits)) for name in frfs}
    return suspected_sensitivities(frfs, systems)


def _diagnosed(run: Run) -> list[FittedModes]:
    """The model with all that the diagnosis found missing; none where that is nothing."""
    from ema_pipeline.fit.parameters import restored
    from ema_pipeline.observations.fitting import model_with
    from ema_pipeline.run.models import mode_observations

    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    last = found.ladder.rungs[-1] if found is not None and found.ladder.rungs else None
    if last is None or run.rig is None or set(last.effects) <= set(run.info.effects):
        return []
    model = model_with(last.effects, run.rig, run.library)
    fit = replace(run.store.load("fit", ALL, "fit", FitResult), unknowns=last.unknowns)
    return [restored(mode_observations(run).suited(model.effects), model, fit)]
