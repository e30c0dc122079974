"""Force-displacement loops in the stages that judge effects: what the diagnosis and the ladder do with them."""

from __future__ import annotations

import dataclasses
from typing import cast

from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import IsolatorResult, Loop, LoopModel
from ema_pipeline.observations.loop_data import settings_differ
from ema_pipeline.observations.loops import LoopObservations
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.store import ALL


def diagnose_run(run: Run, progress: Progress) -> dict[str, object]:
    """What the isolator's model is missing, on top of the model as it stands."""
    from ema_pipeline.diagnose.loops import diagnose_loops, loop_model, loop_models
    from ema_pipeline.threads import single_blas_thread

    settings = cast(DiagnoseSettings, run.settings["diagnose"])
    with single_blas_thread():
        observations = loop_observations(run)
        known = loop_model(observations, run.library, run.info.effects)
        found = diagnose_loops(observations, run.library, known, settings, progress)
        models = loop_models(observations, run.library, found.ladder)
    return {"diagnosis": found, "models": models, "on_top_of": run.info.effects}


def ladder_run(run: Run, progress: Progress) -> dict[str, object]:
    """The effects that the user added, rung by rung; the linear spring alone is no ladder, but can be compared."""
    from ema_pipeline.diagnose.loops import loop_model, loop_models
    from ema_pipeline.diagnose.rungs import make_ladder
    from ema_pipeline.threads import single_blas_thread

    effects = run.info.effects
    with single_blas_thread():
        observations = loop_observations(run)
        rungs = [loop_model(observations, run.library, effects[:k]) for k in range(len(effects) + 1)]
        progress(0.1, "fitting every rung")
        ladder = make_ladder(observations, rungs)
        models = loop_models(observations, run.library, ladder)
    return {"models": models, **({"ladder": ladder} if effects else {})}


def loop_observations(run: Run) -> LoopObservations:
    """The measured loops of all configurations on the run's isolator."""
    assert run.rig is not None  # checked when the run was described
    loops = loops_of(run)
    return LoopObservations(run.rig, loops, own_scales=_own_scales(run, loops))


def loops_of(run: Run) -> tuple[Loop, ...]:
    """Loops of all configurations; they bear their configuration's name where there are several."""
    names = run.info.configurations
    found: list[Loop] = []
    for name in names:
        for loop in run.store.load("loops", name, "isolator", IsolatorResult).loops:
            label = f"{name}/{loop.name}" if len(names) > 1 else loop.name
            found.append(dataclasses.replace(loop, name=label))
    return tuple(found)


def _own_scales(run: Run, loops: tuple[Loop, ...]) -> bool:
    """Whether each loop has a force scale of its own; several configurations are several settings of one device."""
    settings = cast(LoopSettings, run.settings["loops"])
    if len(loops) < 2 or settings.own_scales != "auto":
        return len(loops) > 1 and settings.own_scales == "yes"
    return len(run.info.configurations) > 1 or settings_differ(loops, settings.significance)


def own_models(run: Run) -> tuple[LoopModel, ...]:
    """The linear spring and every rung with the effects that the user added, the model as it stands last."""
    return run.store.load("ladder", ALL, "models", tuple[LoopModel, ...])


def models_of(run: Run) -> tuple[LoopModel, ...]:
    """Models of the user's own ladder or else of the diagnosis, the linear spring first; empty before either."""
    mine = run.store.find("ladder", ALL, "models", tuple[LoopModel, ...]) or ()
    if len(mine) > 1:
        return mine
    return run.store.find("diagnose", ALL, "models", tuple[LoopModel, ...]) or mine
