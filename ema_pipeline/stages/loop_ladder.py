"""Force-displacement loops in the stages that judge effects: what the diagnosis and the ladder do with them."""

from __future__ import annotations

import dataclasses
from typing import cast

from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.loops.settings import HysteresisSettings
from ema_pipeline.loops.types import IsolatorResult, Loop, LoopModel
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.store import ALL


def diagnose_run(run: Run, progress: Progress) -> dict[str, object]:
    """Every set of effects on top of the model as it stands, judged by all loops together."""
    from ema_pipeline.loops.diagnosis import diagnose_loops

    settings = DiagnoseSettings()
    found, models = diagnose_loops(loops_of(run), run.info.effects, settings, loop_settings(run), progress)
    return {"diagnosis": found, "models": models, "on_top_of": run.info.effects}


def climb_run(run: Run, progress: Progress) -> dict[str, object]:
    """The effects that the user added, rung by rung; the linear spring alone is no ladder, but can be compared."""
    from ema_pipeline.loops.ladder import make_loop_ladder

    ladder, models = make_loop_ladder(loops_of(run), run.info.effects, loop_settings(run), progress)
    return {"models": models, **({"ladder": ladder} if run.info.effects else {})}


def loops_of(run: Run) -> tuple[Loop, ...]:
    """Loops of all configurations; they bear their configuration's name where there are several."""
    names = run.info.configurations
    found: list[Loop] = []
    for name in names:
        for loop in run.store.load("loops", name, "isolator", IsolatorResult).loops:
            label = f"{name}/{loop.name}" if len(names) > 1 else loop.name
            found.append(dataclasses.replace(loop, name=label))
    return tuple(found)


def loop_settings(run: Run) -> HysteresisSettings:
    """Settings of the loops; several configurations are several settings of one device."""
    settings = cast(HysteresisSettings, run.settings["loops"])
    if len(run.info.configurations) > 1 and settings.own_scales == "auto":
        return settings.model_copy(update={"own_scales": "yes"})
    return settings


def own_models(run: Run) -> tuple[LoopModel, ...]:
    """The linear spring and every rung with the effects that the user added, the model as it stands last."""
    return run.store.load("ladder", ALL, "models", tuple[LoopModel, ...])


def models_of(run: Run) -> tuple[LoopModel, ...]:
    """Models of the user's own ladder or else of the diagnosis, the linear spring first; empty before either."""
    mine = run.store.find("ladder", ALL, "models", tuple[LoopModel, ...]) or ()
    if len(mine) > 1:
        return mine
    return run.store.find("diagnose", ALL, "models", tuple[LoopModel, ...]) or mine
