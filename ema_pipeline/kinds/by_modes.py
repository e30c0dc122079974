"""Models judged by modes and, where there are hits at several force levels, by the modes of every hit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ema_pipeline.check_result import CheckResult
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.kinds.base import Judge, Results
from ema_pipeline.run.measured import level_studies, modes_key
from ema_pipeline.run.types import Progress, Run

if TYPE_CHECKING:
    from ema_pipeline.diagnose.types import Diagnosis, Ladder
    from ema_pipeline.rigs.types import Rig


_MOST_ALIKE = 3
"""Failures of one check that are all told."""


def judge(run: Run) -> Judge | None:
    """The judge of a run with a rig."""
    return None if run.rig is None else BY_MODES


def diagnose(run: Run, progress: Progress) -> Results:
    """What the model is missing, and where model and measurement differ once that is added."""
    assert run.rig is not None
    found = _diagnosed(run, progress)
    results: Results = {
        "diagnosis": found,
        "on_top_of": run.info.effects,
        "modes_key": modes_key(run),
    }
    top = found.ladder.rungs[-1]
    if top.effects and not any(depends_on_level(x, run.library) for x in top.effects):
        results |= _compared_with(run, run.rig, top.effects, top.unknowns)
    return results


def _diagnosed(run: Run, progress: Progress) -> Diagnosis:
    from ema_pipeline.diagnose.diagnosis import diagnose
    from ema_pipeline.run.models import amplitude_observations, known_model, library_of, mode_observations
    from ema_pipeline.threads import single_blas_thread

    model, hits = run.require_model("diagnose"), amplitude_observations(run)
    notes = (*_level_summaries(run), *_failed_checks(run)) if hits else _failed_checks(run)
    with single_blas_thread():
        return diagnose(
            hits or mode_observations(run),
            model,
            library_of(run, hits),
            known_model(run, hits),
            run.settings.diagnose,
            progress,
            notes,
            linear=hits is None,
        )


def _level_summaries(run: Run) -> tuple[str, ...]:
    """What the study of the force levels says of every configuration in which something moves with the force."""
    return tuple(s.summary for s in level_studies(run).values() if s.level_dependent)


def _failed_checks(run: Run) -> tuple[str, ...]:
    """What the checks on the FRFs found, for a reader who might otherwise blame the model."""
    found = []
    for name in run.info.configurations:
        frfs = run.store.find("frf", name, "frfs", FrfSet)
        failed: dict[str, list[CheckResult]] = {}
        for v in () if frfs is None else frfs.verdicts:
            if not v.passes and v.message:
                failed.setdefault(v.check, []).append(v)
        found += [f"{name}: {text}" for alike in failed.values() for text in _told(alike)]
    return tuple(found)


def _told(failed: Sequence[CheckResult]) -> list[str]:
    """Messages of one check that fails; of many the worst one."""
    if len(failed) <= _MOST_ALIKE:
        return [v.message for v in failed]
    worst = max(failed, key=lambda v: abs(v.value - v.limit))
    return [f"{worst.message} (the worst of {len(failed)})"]


def _compared_with(run: Run, rig: Rig, labels: Sequence[str], unknowns: Mapping[str, float]) -> Results:
    """Where model and measurement differ once these effects are in the model, and that model."""
    from ema_pipeline.fit.parameters import deviations_of, fit_modes
    from ema_pipeline.observations.fitting import model_with
    from ema_pipeline.run.models import correlate, mode_observations

    mended = rig_with_effects(rig, labels, run.library)
    model = model_with(labels, rig, run.library)
    fitted = fit_modes(mode_observations(run).suited(model.effects), model, start=unknowns or None)
    systems = {f"system after {name}": fitted.system(name) for name in run.info.configurations}
    systems |= {f"like parts {name}": fitted.system_of_like_parts(name) for name in run.info.configurations}
    moved = deviations_of(fitted.fit)
    return {"comparison_after": correlate(run, mended, fitted)[1], "deviations after": moved, **systems}


def ladder(run: Run, progress: Progress) -> Results:
    """The base model and every rung above it; without added effects that is left to a diagnosis of the same data."""
    from ema_pipeline.run.models import diagnosis_is_of_other_data

    if not run.info.effects and not diagnosis_is_of_other_data(run):
        return {}
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
    from ema_pipeline.observations.fitting import model_with
    from ema_pipeline.observations.in_full import fit_in_full
    from ema_pipeline.run.models import (
        amplitude_observations,
        diagnosed_scatters,
        earlier_unknowns,
        library_of,
        mode_observations,
    )
    from ema_pipeline.threads import single_blas_thread

    run.require_model("ladder")
    assert run.rig is not None
    hits = amplitude_observations(run)
    unseen = next((x for x in run.info.effects if depends_on_level(x, run.library)), "")
    if unseen and hits is None:
        raise EmaError(
            f"{run.store.folder}: '{unseen}' shows in hits at several force levels only, and there are none: "
            "strike with several forces, or do without this effect"
        )
    effects, library = run.info.effects, library_of(run, hits)
    models = [
        model_with(effects[:k], run.rig, library, with_hits=hits is not None) for k in range(len(effects) + 1)
    ]
    observations = (hits or mode_observations(run)).suited(models[-1].effects)
    with single_blas_thread():
        known = earlier_unknowns(run, ())
        fits = fits_of(observations, models, begun_at(observations, models[0], known) if known else None)
        full, top = fit_in_full(observations, fits[-1], run.settings.diagnose.processes)
        return ladder_of(full, [*fits[:-1], top], diagnosed_scatters(run))


def _check_model(run: Run) -> None:
    _ = run.model  # refuses effects and places that do not exist


BY_MODES = Judge(
    diagnose,
    ladder,
    _check_model,
    stages=frozenset({"ladder", "diagnose", "fit", "correlate"}),
    ladder_of_diagnosis=True,
)
