"""Records of continuous excitation in the stages that judge effects: simulated where the model is small enough."""

from __future__ import annotations

from typing import cast

from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Diagnosis, Ladder
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.observations.modal_rig import rig_of_modes
from ema_pipeline.observations.records import MOST_COORDINATES, RecordObservations
from ema_pipeline.rigs.types import Rig
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.ingest import driven_records
from ema_pipeline.store import ALL
from ema_pipeline.toml_text import parse_toml


def by_records(run: Run) -> bool:
    """True where a continuous test is judged by simulating its records: one configuration, and a small model.

    The model is a rig file of masses and springs, or, without a rig, the identified modes. Rigs that ship with the
    program have effects of their own, which show in modes.
    """
    if run.info.kind != "continuous" or len(run.info.configurations) != 1:
        return False
    if run.rig is None:
        return True
    coordinates = len(run.rig.assembly(run.rig.configurations[0]).dofs)
    return coordinates <= MOST_COORDINATES and (run.built_rig is not None or _of_elements(run.info.rig))


def _of_elements(rig: str) -> bool:
    """True for the text of a rig file that lists masses."""
    return "\n" in rig and "masses" in parse_toml(rig, "rig")


def linear_rig(run: Run) -> Rig:
    """The run's rig, or the one that its modes make."""
    if run.rig is not None:
        return run.rig
    configuration = run.info.configurations[0]
    modal = run.store.load("modal", configuration, "modal", ModalModel)
    frfs = run.store.load("frf", configuration, "frfs", FrfSet)
    return rig_of_modes(modal, frfs, configuration, MOST_COORDINATES)


def require_model(run: Run, stage: str) -> None:
    """Make sure that there is a model to work with, and that it has the effects that the user added.

    Raises
    ------
    EmaError
        Without a model, unless it is made of the identified modes, and for effects and places that do not exist.
    """
    if not by_records(run):
        run.require_model(stage)
        return
    rig = linear_rig(run)
    for label in run.info.effects:
        parse_effect(label, rig, library=run.library)


def record_observations(run: Run) -> RecordObservations:
    """The records of the run's only configuration.

    Raises
    ------
    EmaError
        Where no record may be fitted, and where forces are left in volts.
    """
    configuration = run.info.configurations[0]
    records = driven_records(run.store, configuration)
    fitted = [r for r in records if not r.held_out]
    if not fitted:
        raise EmaError(f'{run.info.raw}: every record is held out; give at least one use = "fit"')
    _check_alike(records)
    return RecordObservations(
        linear_rig(run),
        configuration,
        fitted,
        [r for r in records if r.held_out],
        run.store.load("frf", configuration, "frfs", FrfSet),
        modal=run.rig is None,
    )


def _check_alike(records: tuple[DrivenRecord, ...]) -> None:
    first = records[0]
    for r in records:
        if [c.dof.point for c in r.channels] != [c.dof.point for c in first.channels]:
            raise EmaError(
                f"record '{r.name}': its sensors sit elsewhere than those of '{first.name}'; records of one "
                "simulation need the same sensors, put it into a test of its own"
            )


def diagnose_run(run: Run, progress: Progress) -> dict[str, object]:
    """What the model is missing, on top of the effects that the user added, and its free-run errors."""
    from ema_pipeline.diagnose.free_run import free_run
    from ema_pipeline.diagnose.hysteresis_loop import hysteresis_loops
    from ema_pipeline.diagnose.records import diagnose_records
    from ema_pipeline.threads import single_blas_thread

    settings = cast(DiagnoseSettings, run.settings["diagnose"])
    with single_blas_thread():
        observations = record_observations(run)
        found = diagnose_records(observations, run.library, run.info.effects, settings, progress)
        progress(0.95, "free run")
        errors = free_run(observations, run.library, found.ladder)
        loops = hysteresis_loops(observations, run.library, found.ladder)
    return {"diagnosis": found, "simulation": errors, "hysteresis": loops, "on_top_of": run.info.effects}


def ladder_run(run: Run, progress: Progress) -> dict[str, object]:
    """The effects that the user added, rung by rung, with the free-run errors of the last one."""
    from ema_pipeline.diagnose.free_run import free_run
    from ema_pipeline.diagnose.hysteresis_loop import hysteresis_loops
    from ema_pipeline.diagnose.records import records_ladder
    from ema_pipeline.threads import single_blas_thread

    effects = run.info.effects
    if not effects:
        return {}
    with single_blas_thread():
        observations = record_observations(run)
        progress(0.1, "fitting every rung")
        searched = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
        known = None if searched is None else searched.ladder
        ladder: Ladder = records_ladder(observations, run.library, effects, known)
        return {
            "ladder": ladder,
            "simulation": free_run(observations, run.library, ladder),
            "hysteresis": hysteresis_loops(observations, run.library, ladder),
        }
