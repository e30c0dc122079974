"""Modes of all configurations → fitted parameters of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ema_pipeline.diagnose.types import NOT_DETERMINED, Ladder
from ema_pipeline.fit.types import FitResult, ParameterEstimate
from ema_pipeline.run.measured import measured_modes, modes_key
from ema_pipeline.run.types import Progress, Run
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
    """Fit all parameters to all configurations at once, and the base model beside the one with added effects."""
    from ema_pipeline.fit.parameters import deviations_of, fit_modes, fit_result
    from ema_pipeline.observations.fitting import Model
    from ema_pipeline.run.models import (
        diagnosed_scatters,
        earlier_unknowns,
        known_model,
        mode_observations,
        rung_unknowns,
    )
    from ema_pipeline.threads import single_blas_thread

    rig = run.require_model(NAME)
    with single_blas_thread():
        model, ladder = known_model(run), run.store.find("ladder", ALL, "ladder", Ladder)
        observations = mode_observations(run).suited(model.effects)
        told = diagnosed_scatters(run) if ladder is None else {s.name: s.learned for s in ladder.scatters}
        # an effect that was added may call for one that was not learned
        known = {name: told.get(name, s.default) for name, s in observations.scatters.items()}
        scatters = known if told else None

        def begun(effects: Sequence[str]) -> dict[str, float] | None:
            return rung_unknowns(ladder, effects) or earlier_unknowns(run, effects) or None

        base = fitted = fit_modes(observations, model, scatters, begun(run.info.effects))
        if model.effects:
            base = fit_modes(observations, Model(), fitted.posterior.scatters, begun(()))
        progress(0.6, "error function")
        found = fit_result(fitted, rig, measured_modes(run), run.settings.fit)
    return {
        "fit": found if ladder is None else _with_sizes(found, ladder),
        "base_unknowns": base.fit.unknowns,
        "deviations": deviations_of(fitted.fit),
        "base deviations": deviations_of(base.fit),
        "modes_key": modes_key(run),
        **{f"like parts {name}": fitted.system_of_like_parts(name) for name in run.info.configurations},
        **{f"base like parts {name}": base.system_of_like_parts(name) for name in run.info.configurations},
        **{f"system {name}": fitted.system(name) for name in run.info.configurations},
        **{f"base system {name}": base.system(name) for name in run.info.configurations},
    }


def _with_sizes(found: FitResult, ladder: Ladder) -> FitResult:
    """The fit with the sizes of effects that only hits show, as the ladder found them."""
    more = {}
    for name, size in ladder.rungs[-1].parameters.items():
        if "@" in name and name not in found.parameters:
            more[name] = ParameterEstimate(
                name, size.value, size.std, size.value - size.std, size.value + size.std, size.unit, True,
                size.value, float("nan"), size.determined, float("nan"),
                "" if size.determined else NOT_DETERMINED,
            )  # fmt: skip
    return replace(found, parameters=found.parameters | more)
