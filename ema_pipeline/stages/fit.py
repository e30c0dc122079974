"""Modes of all configurations → fitted parameters of the model."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import FitResult, ParameterEstimate
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.modes import measured_modes
from ema_pipeline.store import ALL

NAME = "fit"
NEEDS = ("modal", "ladder")
USES = ("levels", "diagnose")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """The user's own effects take part."""
    return run.effect_hashes()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit all parameters to all configurations at once."""
    from ema_pipeline.fit.parameters import fit_modes, fit_result
    from ema_pipeline.stages.models import known_model, mode_observations
    from ema_pipeline.threads import single_blas_thread

    settings = cast(FitSettings, run.settings[NAME])
    rig = run.require_model(NAME)
    with single_blas_thread():
        fitted = fit_modes(mode_observations(run), known_model(run), _scatters(run))
        progress(0.6, "error function")
        found = fit_result(fitted, rig, measured_modes(run), settings)
    ladder = run.store.find("ladder", ALL, "ladder", Ladder)
    return {"fit": found if ladder is None else _with_sizes(found, ladder)}


def _scatters(run: Run) -> dict[str, float] | None:
    """The scatters at which the diagnosis compares models, so that an error is the same wherever it stands."""
    from ema_pipeline.stages.models import mode_observations

    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    if found is None or not found.ladder.scatters:
        return None
    own = mode_observations(run).scatters
    return {s.name: s.learned for s in found.ladder.scatters if s.name in own}


def _with_sizes(found: FitResult, ladder: Ladder) -> FitResult:
    """The fit with the sizes of effects that only hits show, as the ladder found them."""
    more = {}
    for name, size in ladder.rungs[-1].parameters.items():
        if "@" in name and name not in found.parameters:
            more[name] = ParameterEstimate(
                name, size.value, size.std, size.value - size.std, size.value + size.std, size.unit, True,
                size.value, float("nan"), size.told, float("nan"), "" if size.told else "not told by these data",
            )  # fmt: skip
    return replace(found, parameters=found.parameters | more)
