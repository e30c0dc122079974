"""Modes, hits and model → which physics the model is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.stages import driven, loop_ladder
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.correlate import correlate
from ema_pipeline.stages.levels import level_studies
from ema_pipeline.stages.modes import modes_key

if TYPE_CHECKING:
    from ema_pipeline.diagnose.types import Diagnosis

NAME = "diagnose"
NEEDS = ("frf", "modal")
USES = ("levels", "loops")
PER_CONFIGURATION = False
NEEDS_RIG = True


def inputs(run: Run, configuration: str) -> str:
    """The user's own effects take part."""
    return run.effect_hashes()


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Fit every effect of the library on top of the model as it stands, and judge what the data support."""
    return _found(run, progress) | {"choices": run.info.choices}


def _found(run: Run, progress: Progress) -> dict[str, object]:
    if run.info.kind == "hysteresis":
        return loop_ladder.diagnose_run(run, progress)
    if driven.by_records(run):
        return driven.diagnose_run(run, progress)
    if run.rig is None:
        return {}
    found = _diagnosed(run, progress)
    results: dict[str, object] = {
        "diagnosis": found,
        "on_top_of": run.info.effects,
        "modes_key": modes_key(run),
    }
    top = found.ladder.rungs[-1]
    if top.effects and not any(depends_on_level(x, run.library) for x in top.effects):
        results |= _compared_with(run, top.effects, top.unknowns)
    return results


def _diagnosed(run: Run, progress: Progress) -> Diagnosis:
    """By modes and, where there are hits at several levels, by the modes of every hit."""
    from ema_pipeline.diagnose.diagnosis import diagnose
    from ema_pipeline.stages.amplitude import amplitude_observations
    from ema_pipeline.stages.models import known_model, mode_observations
    from ema_pipeline.threads import single_blas_thread

    model, hits = run.require_model(NAME), amplitude_observations(run)
    notes = (*_level_summaries(run), *failed_checks(run)) if hits else failed_checks(run)
    with single_blas_thread():
        return diagnose(
            hits or mode_observations(run),
            model,
            run.library,
            known_model(run, with_hits=hits is not None),
            cast(DiagnoseSettings, run.settings[NAME]),
            progress,
            notes,
            linear=hits is None,
        )


def _level_summaries(run: Run) -> tuple[str, ...]:
    """What the study of the force levels says of every configuration in which something moves with the force."""
    return tuple(s.summary for s in level_studies(run).values() if s.level_dependent)


def _compared_with(run: Run, labels: Sequence[str], unknowns: Mapping[str, float]) -> dict[str, object]:
    """Where model and measurement differ once these effects are in the model, and that model."""
    from ema_pipeline.fit.parameters import deviations_of, fit_modes
    from ema_pipeline.stages.models import mode_observations, model_with

    assert run.rig is not None
    mended = rig_with_effects(run.rig, labels, run.library)
    fitted = fit_modes(mode_observations(run), model_with(run, mended, labels), start=unknowns or None)
    systems = {f"system after {name}": fitted.system(name) for name in run.info.configurations}
    systems |= {f"like parts {name}": fitted.system_of_like_parts(name) for name in run.info.configurations}
    moved = deviations_of(fitted.fit)
    return {"comparison_after": correlate(run, mended, fitted)[1], "deviations after": moved, **systems}


def failed_checks(run: Run) -> tuple[str, ...]:
    """What the checks on the FRFs found, for a reader who might otherwise blame the model."""
    found = []
    for name in run.info.configurations:
        frfs = run.store.find("frf", name, "frfs", FrfSet)
        verdicts = () if frfs is None else frfs.verdicts
        found += [f"{name}: {v.message}" for v in verdicts if not v.passes and v.message]
    return tuple(found)
