"""Modes and model → which physics the model is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from ema_pipeline.correlate.types import Comparison
from ema_pipeline.diagnose.progress import part
from ema_pipeline.diagnose.settings import DiagnoseSettings as LevelSettings
from ema_pipeline.diagnosis.settings import DiagnoseSettings
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages import loop_ladder
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.correlate import correlate
from ema_pipeline.stages.level_case import all_tests, level_case, linear_part

if TYPE_CHECKING:
    from ema_pipeline.diagnose.levels.prepare import LevelTest
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
    if run.info.kind == "hysteresis":
        return loop_ladder.diagnose_run(run, progress)
    model = run.require_model(NAME)
    tests = all_tests(run)
    known = any(t.study.level_dependent for t in tests)
    if known or (tests and any(depends_on_level(x, run.library) for x in run.info.effects)):
        of_hits = by_hits(run, tests, part(progress, 0.0, 0.9))
        if not linear_after_all(run, tests, of_hits):
            return {"diagnosis": of_hits, "on_top_of": run.info.effects}
        found = with_limits(by_modes(run, model, part(progress, 0.9, 1.0)), of_hits)
    elif any(len(t.levels) > 1 for t in tests):
        found = with_hits(
            run, tests, by_modes(run, model, part(progress, 0.0, 0.5)), part(progress, 0.5, 1.0)
        )
    else:
        found = by_modes(run, model, progress)
    results: dict[str, object] = {"diagnosis": found, "on_top_of": run.info.effects}
    top = found.ladder.rungs[-1]
    if top.effects and not any(depends_on_level(x, run.library) for x in top.effects):
        results["comparison_after"] = _compared_with(run, top.effects)
    return results


def _compared_with(run: Run, labels: Sequence[str]) -> Comparison:
    """Where model and measurement part once these effects are in the model."""
    from ema_pipeline.fit.parameters import fit_modes
    from ema_pipeline.stages.models import mode_observations, model_with

    assert run.rig is not None
    mended = rig_with_effects(run.rig, labels, run.library)
    fitted = fit_modes(mode_observations(run), model_with(run, mended, labels))
    return correlate(run, mended, fitted)[1]


def by_modes(run: Run, model: Rig, progress: Progress) -> Diagnosis:
    """The diagnosis where the answer does not depend on the force level."""
    from ema_pipeline.diagnosis.diagnosis import diagnose
    from ema_pipeline.stages.models import known_model, mode_observations
    from ema_pipeline.threads import single_blas_thread

    settings = cast(DiagnoseSettings, run.settings[NAME])
    with single_blas_thread():
        return diagnose(
            mode_observations(run),
            model,
            run.library,
            known_model(run),
            settings,
            progress,
            failed_checks(run),
        )


_EXACT = 0.002
"""Share of the measured amplitude: a model that misses no more of any hit explains them as well as any could."""

_CHANCE = 1e-4
"""Least p value of the study of the levels that may yet be chance."""


def linear_after_all(run: Run, tests: Sequence[LevelTest], found: Diagnosis) -> bool:
    """True where a linear model explains the hits of all levels as well as any model could.

    What the study of the levels saw was then chance, and the modes of its level are as good as any.
    """
    chance = all(t.study.p_value >= _CHANCE for t in tests if t.study.level_dependent)
    exact = found.ladder.hit_noise <= _EXACT and found.error <= 1.0
    return (
        chance and exact and not any(depends_on_level(x, run.library) for x in found.ladder.rungs[-1].effects)
    )


def with_hits(run: Run, tests: Sequence[LevelTest], found: Diagnosis, progress: Progress) -> Diagnosis:
    """A diagnosis by modes, and what simulated hits add to it where no mode is seen to move with the force.

    Simulated hits show smaller effects than the modes do: a third harmonic is no shift of a frequency. Where they
    claim an effect that depends on the level, theirs is the diagnosis; else they tell what they would have shown.
    """
    from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels

    missing = found.ladder.rungs[-1].effects if found.verdict == "effect" else ()
    starts = [{n: p.value for n, p in rung.parameters.items()} for rung in found.ladder.rungs[::-1]]
    try:
        case = level_case(run, tests, starts[:3])
        of_hits = diagnose_levels(
            case, (*run.info.effects, *missing), found if missing else None, "", failed_checks(run), progress
        )
    except EmaError as error:
        return replace(found, notes=(*found.notes, f"The hits could not be simulated: {error}"))
    if any(depends_on_level(x, run.library) for x in of_hits.ladder.rungs[-1].effects):
        return of_hits
    return with_limits(found, of_hits)


def with_limits(found: Diagnosis, of_hits: Diagnosis) -> Diagnosis:
    """A diagnosis by modes with what the hits would have shown besides."""
    return replace(found, detection_limits=(*found.detection_limits, *of_hits.detection_limits))


def by_hits(run: Run, tests: Sequence[LevelTest], progress: Progress) -> Diagnosis:
    """The diagnosis where the answer depends on the force level: by the modes of one level, then by all hits.

    Modes of a single level show what is missing at every level. The softest hits are nearest to a linear rig for
    stiffness that changes with deflection, the hardest for friction.
    """
    from ema_pipeline.diagnose import diagnose
    from ema_pipeline.diagnose.levels.diagnosis import diagnose_levels
    from ema_pipeline.diagnose.levels.linear_claims import without, without_time_response
    from ema_pipeline.diagnose.levels.prepare import soft_and_hard

    settings = LevelSettings()
    linear = linear_part(run)
    found: list[Diagnosis] = []
    for i, modes in enumerate(soft_and_hard(tests)):
        tell = part(progress, 0.15 * i, 0.15 * (i + 1))
        # what one level asks for besides may come of the force: the hits of all levels tell
        found.append(diagnose(linear, modes, settings, run.library, tell, first_only=True))
        if found[-1].verdict in ("adequate", "not_enough_data"):
            break
    best = min(found, key=lambda d: (_TRUSTED.index(d.verdict), d.ladder.rungs[-1].error))
    missing = best.ladder.rungs[-1].effects if best.verdict == "effect" else ()
    if not all(_seen(d, missing) for d in found):
        missing = ()
    notes = failed_checks(run)
    steady = without_time_response(linear, [t.configuration for t in tests], missing, settings, run.library)
    if steady:
        missing = tuple(x for x in missing if x not in steady)
        notes = (_steady_text(steady), *notes)
    starts = [
        {n: p.value for n, p in rung.parameters.items()}
        for d in (best, *found)
        for rung in d.ladder.rungs[::-1]
    ]
    case = level_case(run, tests, starts[:3])
    return diagnose_levels(
        case,
        (*run.info.effects, *missing),
        without(best, steady) if missing else None,
        " ".join(t.study.summary for t in tests if t.study.level_dependent),
        notes,
        part(progress, 0.3, 1.0),
    )


def _steady_text(labels: set[str]) -> str:
    """A remark where effects of single levels cannot be simulated in time."""
    from ema_pipeline.diagnose.explain import label_text

    named = " and ".join(label_text(x) for x in sorted(labels))
    return f"The modes of one level ask for {named}, which has no time response: the hits are simulated without it."


def _seen(found: Diagnosis, labels: Sequence[str]) -> bool:
    """True where a diagnosis knows all these effects as likely: what is missing at every level shows at every level."""
    likely = {c.label for c in found.candidates[:_LIKELY] if c.gain > c.threshold}
    return set(labels) <= likely | {c.label for c in found.candidates if c.claimed}


_LIKELY = 3


_TRUSTED = ("adequate", "not_enough_data", "effect", "ambiguous", "unknown_effect")
"""Verdicts on the modes of one level, those first that speak for a level near to a linear rig."""


def failed_checks(run: Run) -> tuple[str, ...]:
    """What the checks on the FRFs found, for a reader who might otherwise blame the model."""
    found = []
    for name in run.info.configurations:
        frfs = run.store.find("frf", name, "frfs", FrfSet)
        verdicts = () if frfs is None else frfs.verdicts
        found += [f"{name}: {v.message}" for v in verdicts if not v.passes and v.message]
    return tuple(found)
