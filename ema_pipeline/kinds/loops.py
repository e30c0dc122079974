"""Force-displacement loops of isolators: their model is a spring to begin with, judged by the loops themselves."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError
from ema_pipeline.kinds.base import Judge, Kind, Results
from ema_pipeline.loops.types import IsolatorResult, Loop, LoopModel
from ema_pipeline.rigs.types import Rig
from ema_pipeline.run.types import Progress, Run
from ema_pipeline.store import ALL

if TYPE_CHECKING:
    from ema_pipeline.observations.loops import LoopObservations


def diagnose(run: Run, progress: Progress) -> Results:
    """What the isolator's model is missing, on top of the current model."""
    from ema_pipeline.diagnose.loops import diagnose_loops, loop_model, loop_models
    from ema_pipeline.threads import single_blas_thread

    with single_blas_thread():
        observations = loop_observations(run)
        known = loop_model(observations, run.library, run.info.effects)
        found = diagnose_loops(observations, run.library, known, run.settings.diagnose, progress)
        models = loop_models(observations, run.library, found.ladder)
    return {"diagnosis": found, "models": models, "on_top_of": run.info.effects}


def ladder(run: Run, progress: Progress) -> Results:
    """The effects that the user added, rung by rung; the linear spring alone is no ladder, but can be compared."""
    from ema_pipeline.diagnose.loops import loop_model, loop_models
    from ema_pipeline.diagnose.rungs import make_ladder
    from ema_pipeline.threads import single_blas_thread

    effects = run.info.effects
    with single_blas_thread():
        observations = loop_observations(run)
        rungs = [loop_model(observations, run.library, effects[:k]) for k in range(len(effects) + 1)]
        progress(0.1, "fitting every rung")
        found = make_ladder(observations, rungs)
        models = loop_models(observations, run.library, found)
    return {"models": models, **({"ladder": found} if effects else {})}


def loop_observations(run: Run) -> LoopObservations:
    """The measured loops of all configurations on the run's isolator."""
    from ema_pipeline.observations.loop_data import have_own_scales
    from ema_pipeline.observations.loops import LoopObservations

    assert run.rig is not None  # checked when the run was described
    loops = loops_of(run)
    several = len(run.info.configurations) > 1
    return LoopObservations(
        run.rig, loops, own_scales=have_own_scales(loops, run.settings.loops, several_settings=several)
    )


def loops_of(run: Run) -> tuple[Loop, ...]:
    """Loops of all configurations; they bear their configuration's name where there are several."""
    names = run.info.configurations
    found: list[Loop] = []
    for name in names:
        for loop in run.store.load("loops", name, "isolator", IsolatorResult).loops:
            label = f"{name}/{loop.name}" if len(names) > 1 else loop.name
            found.append(dataclasses.replace(loop, name=label))
    return tuple(found)


def own_models(run: Run) -> tuple[LoopModel, ...]:
    """The linear spring and every rung with the effects that the user added, the current model last."""
    return run.store.load("ladder", ALL, "models", tuple[LoopModel, ...])


def models_of(run: Run) -> tuple[LoopModel, ...]:
    """Models of the user's own ladder or else of the diagnosis, the linear spring first; empty before either."""
    mine = run.store.find("ladder", ALL, "models", tuple[LoopModel, ...]) or ()
    if len(mine) > 1:
        return mine
    return run.store.find("diagnose", ALL, "models", tuple[LoopModel, ...]) or mine


def _check_model(run: Run) -> None:
    from ema_pipeline.observations.loop_forces import effects_of_loops

    assert run.rig is not None
    _ = run.model  # refuses effects and places that do not exist
    effects_of_loops(run.rig, run.info.effects, run.library)  # refuses what a loop does not show


def _check_rig(rig: Rig, source: str) -> None:
    from ema_pipeline.effects.isolators import isolators

    if not any(isolators(rig.assembly(name)) for name in rig.configurations):
        raise EmaError(f"{source}: has no isolator that loops could be measured on; leave --rig out")


BY_LOOPS = Judge(diagnose, ladder, _check_model)

KIND = Kind(
    name="hysteresis",
    words="force-displacement loops",
    measures=("loops",),
    judge=lambda run: BY_LOOPS,
    rig="isolator",
    check_rig=_check_rig,
    of_rig=False,
)
