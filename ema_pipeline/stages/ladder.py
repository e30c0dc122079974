"""The effects that the user added → error fitted and held out, rung by rung."""

from __future__ import annotations

from ema_pipeline.diagnose.types import Ladder
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.errors import EmaError
from ema_pipeline.stages import driven, loop_ladder
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.models import diagnosed_choices, diagnosed_scatters, earlier_unknowns

NAME = "ladder"
NEEDS = ("modal",)
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """Measured with the settings of the diagnosis; the user's own effects take part."""
    alone = "base model" if _stands_in(run) else ""
    return run.settings["diagnose"].model_dump_json() + run.effect_hashes() + alone


def _stands_in(run: Run) -> bool:
    """True where the diagnosis is of other hits or modes, so that the error of the base model is not known from it."""
    return not run.info.effects and diagnosed_choices(run) != run.info.choices


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit the base model and every rung above it; without added effects that is left to the diagnosis."""
    if run.info.kind == "hysteresis":
        return loop_ladder.ladder_run(run, progress)
    if driven.by_records(run):
        return driven.ladder_run(run, progress)
    if not run.info.effects and not _stands_in(run):
        return {}
    if run.rig is None:
        raise EmaError(f"{run.store.folder}: a ladder needs a model; run again with --rig")
    return {"ladder": _measured(run)}


def _measured(run: Run) -> Ladder:
    """The ladder of the effects that the user added, measured by the modes and by hits at several levels.

    Raises
    ------
    EmaError
        For an effect that shows in hits at several levels only, where there are none.
    """
    from ema_pipeline.diagnose.rungs import fits_of, ladder_of
    from ema_pipeline.fit.parameters import begun_at
    from ema_pipeline.observations.fitting import Model
    from ema_pipeline.stages.amplitude import amplitude_observations
    from ema_pipeline.stages.models import mode_observations, model_with
    from ema_pipeline.threads import single_blas_thread

    hits = amplitude_observations(run)
    unseen = next((x for x in run.info.effects if depends_on_level(x, run.library)), "")
    if unseen and hits is None:
        raise EmaError(
            f"{run.store.folder}: '{unseen}' shows in hits at several force levels only, and there are none; "
            f"take it out with 'ema remove {run.store.folder} {unseen}'"
        )
    models = [Model()]
    for label in run.info.effects:
        models.append(model_with(run, run.require_model(NAME), [label], models[-1], hits is not None))
    observations = hits or mode_observations(run)
    with single_blas_thread():
        known = earlier_unknowns(run, ())
        fits = fits_of(observations, models, begun_at(observations, models[0], known) if known else None)
        return ladder_of(observations, fits, diagnosed_scatters(run))
