"""Continuous tests: shakers that drive for as long as a record lasts, their FRFs and modes.

The model is judged by simulating the records where it is small enough, else by its modes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.kinds import by_modes
from ema_pipeline.kinds.base import Judge, Kind, Results
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.rigs.types import Rig
from ema_pipeline.run.measured import without_coherence
from ema_pipeline.run.records import DRIVEN, driven_records, shown
from ema_pipeline.run.sources import tests_of
from ema_pipeline.run.types import Progress, Run
from ema_pipeline.store import ALL
from ema_pipeline.toml_text import parse_toml

if TYPE_CHECKING:
    from ema_pipeline.diagnose.types import Ladder
    from ema_pipeline.observations.free_run import RecordError
    from ema_pipeline.observations.records import RecordObservations


NOT_DIAGNOSED = "not_diagnosed"
"""Name of the reason why nothing was diagnosed, among the results of the stage ``diagnose``."""


def _read(run: Run, configuration: str, progress: Progress) -> Results:
    from ema_pipeline.ingest.driven import load_driven

    test = tests_of(run, configuration)[0]
    records = load_driven(test, run.settings.ingest)
    return {DRIVEN: tuple(shown(records, len(test.records), progress))}


def _frfs(run: Run, configuration: str, progress: Progress) -> FrfSet:
    from ema_pipeline.frf.driven import estimate_driven_frfs

    return estimate_driven_frfs(driven_records(run.store, configuration), run.settings.frf)


def _modes(run: Run, configuration: str, progress: Progress) -> ModalModel:
    from ema_pipeline.modal.chosen import wanted
    from ema_pipeline.modal.circle import attach_circles, identify_by_circle
    from ema_pipeline.modal.identify import identify

    settings, frfs = run.settings.modal, without_coherence(run, configuration)
    if settings.method == "circle":
        return identify_by_circle(frfs, settings.circle)
    included = wanted(run.info.choices.of(configuration).included_modes, frfs.response_decay_rad_s)
    modal = identify(frfs, settings.identify, progress, wanted=included)
    return attach_circles(frfs, modal, settings.circle)


def judge(run: Run) -> Judge | None:
    """The judge by simulated records for one configuration and a small model, else that by modes."""
    return BY_RECORDS if _by_records(run) else by_modes.judge(run)


def _by_records(run: Run) -> bool:
    """True where records are simulated, by a rig file of masses and springs or, without a rig, by the modes.

    Rigs that ship with the program have effects of their own, which show in modes.
    """
    from ema_pipeline.observations.records import MOST_COORDINATES

    if len(run.info.configurations) != 1:
        return False
    if run.rig is None:
        return True
    coordinates = len(run.rig.assembly(run.rig.configurations[0]).dofs)
    return coordinates <= MOST_COORDINATES and (run.built_rig is not None or _of_elements(run.info.rig))


def _of_elements(rig: str) -> bool:
    """True for the text of a rig file that lists masses."""
    return "\n" in rig and "masses" in parse_toml(rig, "rig")


def _without_model(run: Run) -> str:
    """Why a run without a rig has no model to simulate either; empty where its modes make one."""
    if run.rig is not None or run.info.effects:
        return ""
    from ema_pipeline.observations.modal_rig import why_no_rig
    from ema_pipeline.observations.records import MOST_COORDINATES

    return why_no_rig(*_identified(run), MOST_COORDINATES)


def _identified(run: Run) -> tuple[ModalModel, FrfSet]:
    configuration = run.info.configurations[0]
    modal = run.store.load("modal", configuration, "modal", ModalModel)
    return modal, run.store.load("frf", configuration, "frfs", FrfSet)


def linear_rig(run: Run) -> Rig:
    """The run's rig, or the one that its modes make."""
    if run.rig is not None:
        return run.rig
    from ema_pipeline.observations.modal_rig import rig_of_modes
    from ema_pipeline.observations.records import MOST_COORDINATES

    return rig_of_modes(*_identified(run), run.info.configurations[0], MOST_COORDINATES)


def _check_model(run: Run) -> None:
    from ema_pipeline.effects.library import parse_effect

    rig = linear_rig(run)
    for label in run.info.effects:
        parse_effect(label, rig, library=run.library)


def record_observations(run: Run) -> RecordObservations:
    """The records of the run's only configuration.

    Raises
    ------
    EmaError
        Where no record may be fitted, their sensors differ, or forces are left in volts.
    """
    from ema_pipeline.ingest.driven import check_same_sensors
    from ema_pipeline.observations.records import RecordObservations

    configuration = run.info.configurations[0]
    records = driven_records(run.store, configuration)
    fitted = [r for r in records if not r.held_out]
    if not fitted:
        raise EmaError(f'{run.info.raw}: every record is held out; give at least one use = "fit"')
    check_same_sensors(records)
    return RecordObservations(
        linear_rig(run),
        configuration,
        fitted,
        [r for r in records if r.held_out],
        run.store.load("frf", configuration, "frfs", FrfSet),
        modal=run.rig is None,
    )


def diagnose(run: Run, progress: Progress) -> Results:
    """What the model is missing, on top of the effects that the user added, and its free-run errors."""
    from ema_pipeline.diagnose.hysteresis_loop import hysteresis_loops
    from ema_pipeline.diagnose.records import diagnose_records
    from ema_pipeline.threads import single_blas_thread

    if reason := _without_model(run):
        return {NOT_DIAGNOSED: reason}
    with single_blas_thread():
        observations = record_observations(run)
        found = diagnose_records(observations, run.library, run.info.effects, run.settings.diagnose, progress)
        progress(0.95, "free run")
        errors = _free_run(run, observations, found.ladder)
        loops = hysteresis_loops(observations, run.library, found.ladder)
    return {"diagnosis": found, "simulation": errors, "hysteresis": loops, "on_top_of": run.info.effects}


def _free_run(run: Run, observations: RecordObservations, ladder: Ladder) -> tuple[RecordError, ...]:
    """Errors of the first and the last model of a ladder."""
    from ema_pipeline.diagnose.records import record_model
    from ema_pipeline.observations.free_run import free_run

    rungs = ladder.rungs[0], ladder.rungs[-1]
    return free_run(
        observations, [(record_model(observations, run.library, r.effects), r.unknowns) for r in rungs]
    )


def ladder(run: Run, progress: Progress) -> Results:
    """The effects that the user added, rung by rung, with the free-run errors of the last one."""
    from ema_pipeline.diagnose.hysteresis_loop import hysteresis_loops
    from ema_pipeline.diagnose.records import records_ladder
    from ema_pipeline.diagnose.types import Diagnosis
    from ema_pipeline.threads import single_blas_thread

    effects = run.info.effects
    if not effects:
        return {}
    with single_blas_thread():
        observations = record_observations(run)
        progress(0.1, "fitting every rung")
        searched = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
        known = None if searched is None else searched.ladder
        rungs = records_ladder(observations, run.library, effects, known, run.settings.diagnose.processes)
        return {
            "ladder": rungs,
            "simulation": _free_run(run, observations, rungs),
            "hysteresis": hysteresis_loops(observations, run.library, rungs),
        }


BY_RECORDS = Judge(diagnose, ladder, _check_model)

KIND = Kind(
    name="continuous",
    words="records of continuous excitation",
    measures=("ingest", "frf", "modal"),
    judge=judge,
    read=_read,
    frfs=_frfs,
    modes=_modes,
)
