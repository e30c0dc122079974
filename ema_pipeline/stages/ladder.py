"""The effects that the user added → error fitted and held out, rung by rung."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.stages import loop_ladder
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.level_case import all_tests, level_case, linear_part

if TYPE_CHECKING:
    from ema_pipeline.diagnose.types import Ladder

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
    if run.info.kind == "hysteresis":
        return loop_ladder.ladder_run(run, progress)
    if not run.info.effects:
        return {}
    if run.rig is None:
        raise EmaError(f"{run.store.folder}: a ladder needs a model; run again with --rig")
    if any(depends_on_level(label, run.library) for label in run.info.effects):
        return {"ladder": by_hits(run, progress)}
    return {"ladder": by_modes(run)}


def by_modes(run: Run) -> Ladder:
    """The ladder of the effects that the user added, measured by the modes."""
    from ema_pipeline.diagnosis.rungs import make_ladder
    from ema_pipeline.observations.fitting import Model
    from ema_pipeline.stages.models import mode_observations, model_with
    from ema_pipeline.threads import single_blas_thread

    models = [Model()]
    for label in run.info.effects:
        models.append(model_with(run, run.require_model(NAME), [label], models[-1]))
    with single_blas_thread():
        return make_ladder(mode_observations(run), models)


def by_hits(run: Run, progress: Progress) -> Ladder:
    """The ladder of effects that depend on the force level, measured by simulating the hits.

    Raises
    ------
    EmaError
        For a table of modes, which has no hits.
    """
    from ema_pipeline.diagnose.levels.ladder import make_level_ladder
    from ema_pipeline.diagnose.levels.prepare import soft_and_hard
    from ema_pipeline.fit.map_fit import fit_rig

    tests = all_tests(run)
    if not tests:
        label = next(x for x in run.info.effects if depends_on_level(x, run.library))
        raise EmaError(
            f"{run.store.folder}: '{label}' shows in hits only, and there are none; "
            f"take it out with 'ema remove {run.store.folder} {label}'"
        )
    progress(0.0, "modes of single levels")
    fits = [
        fit_rig(
            linear_part(run), modes, cast(FitSettings, run.settings["fit"]), None, lambda share, text: None
        )
        for modes in soft_and_hard(tests)
    ]
    starts = [{n: p.value for n, p in f.parameters.items()} for f in fits]
    case = level_case(run, tests, starts)
    return make_level_ladder(case, run.info.effects, lambda done, text: progress(0.1 + 0.9 * done, text))
