"""Runs on a results folder: a whole pipeline, single stages, a change of the effects in the model."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from ema_pipeline.answers import check_answer_folder
from ema_pipeline.describe import describe
from ema_pipeline.diagnose.types import Diagnosis
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.keys import Keys
from ema_pipeline.kinds import require_judge, stages_of
from ema_pipeline.pipeline import ShowStage, out_of_date, run_stages
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.run.opening import existing_run, load_info, new_run, stored_settings, with_effect_files
from ema_pipeline.run.rollback import everything_taken_back, settings_taken_back
from ema_pipeline.run.settings import override
from ema_pipeline.run.types import Run, RunInfo
from ema_pipeline.store import ALL, CannotWriteError, Store

DescribeSource = Callable[[Path, str | None, str | None, Iterable[str]], RunInfo]
"""Checks what a run starts from; takes source, rig, pipeline and overrides."""


def run_raw(
    raw: Path,
    rig: str | None,
    out: Path,
    pipeline: str | None = None,
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    describe_source: DescribeSource | None = None,
    effect_files: Iterable[str] = (),
) -> tuple[Run, list[str]]:
    """Run a whole pipeline on a raw folder, or on a table of modes.

    Parameters
    ----------
    raw : Path
        Raw folder, or a file with a table of modes.
    rig : str or None
        Name of a rig or path of a rig file. Left out: the ``rig.toml`` beside test.toml, then the rig that
        test.toml names, then none.
    out : Path
        Results folder; made where it does not exist.
    pipeline : str or None
        Name or path of a pipeline; left out, the one made for the rig.
    overrides : iterable of str
        ``stage.key=value``.
    show : ShowStage or None
        Display of progress.
    describe_source : callable
        `describe` for raw folders, `describe_modes` for a table of modes.
    effect_files : iterable of str
        Python files with the user's own effects.

    Returns
    -------
    run : Run
    computed : list of str
        What was computed; empty where everything was up to date.

    Raises
    ------
    EmaError
        Whatever is wrong with data or settings, in one line.
    """
    check_answer_folder(out, RESULTS_FILE)
    info = (describe_source or describe)(raw, rig, pipeline, overrides)
    store, effect_files = Store(out), tuple(effect_files)
    info = with_effect_files(store, info, effect_files)
    new_run(store, info, effect_files).check_effect_files()
    with _tidy(out), store.lock():
        info = _with_decisions_of(store, info)
        with settings_taken_back(store, info):
            run = new_run(store, info, effect_files)
            store.keep(stages_of(run))  # an earlier run may have had a model, or been of another kind of test
            return run, run_stages(run, run.settings.stages, show)


def run_on(
    folder: Path,
    stages: Iterable[str],
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    effect_files: Iterable[str] = (),
) -> tuple[Run, list[str]]:
    """Run single stages on a results folder; settings changed by `overrides` stay changed there unless a stage fails.

    A folder that cannot be written to is taken as it is where all is up to date.

    Raises
    ------
    EmaError
        Whatever is wrong with the folder or the settings, in one line.
    """
    effect_files, stages, overrides = tuple(effect_files), tuple(stages), tuple(overrides)
    store = Store.existing(folder)
    with contextlib.ExitStack() as locked:
        try:
            locked.enter_context(store.lock())
        except CannotWriteError:
            return _as_it_is(folder, effect_files, stages, overrides), []
        info = existing_run(folder, effect_files).info
        settings = override(stored_settings(store, info), overrides, folder)
        info = dataclasses.replace(info, pipeline=settings.model_dump_json())
        run = new_run(store, info, effect_files)
        run.check_effect_files()
        with settings_taken_back(store, info):
            return run, run_stages(run, stages, show)


def _as_it_is(
    folder: Path, effect_files: tuple[str, ...], stages: tuple[str, ...], overrides: tuple[str, ...]
) -> Run:
    """The run of a folder that cannot be written to, where nothing would change there."""
    run = existing_run(folder, effect_files)
    changed = ["settings"] if overrides else out_of_date(run, stages)
    if changed:
        raise EmaError(
            f"{folder}: cannot be written to, and {changed[0]} would change there; "
            "copy the folder to where you can write"
        )
    return run


AFTER_EFFECTS = ("fit", "correlate", "report")
"""Stages that follow once the ladder of changed effects stands."""


def change_effects(
    folder: Path,
    change: Callable[[tuple[str, ...]], tuple[str, ...]],
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    effect_files: Iterable[str] = (),
) -> Run:
    """Change the effects that were added to the model, and refit, compare and report.

    Parameters
    ----------
    folder : Path
        Results folder.
    change : callable
        Takes the effects as they are, returns them as they shall be.
    overrides : iterable of str
        ``stage.key=value``.
    show : ShowStage or None
    effect_files : iterable of str
        Python files with the user's own effects.

    Raises
    ------
    EmaError
        For effects or places that do not exist, and a model that cannot be fitted; nothing is changed then.
    """
    with changed_effects(folder, change, overrides, show, effect_files) as run:
        run_stages(run, AFTER_EFFECTS, show)
    return run


@contextlib.contextmanager
def changed_effects(
    folder: Path,
    change: Callable[[tuple[str, ...]], tuple[str, ...]],
    overrides: Iterable[str] = (),
    show: ShowStage | None = None,
    effect_files: Iterable[str] = (),
) -> Iterator[Run]:
    """Change the effects that were added to the model and measure its ladder; `AFTER_EFFECTS` is left to the block.

    If anything fails, in the block too, the results folder is as it was. Interrupted in the block, the change is kept
    and can be finished. Parameters and errors are those of `change_effects`.
    """
    effect_files = tuple(effect_files)
    store = Store.existing(folder)
    with store.lock():
        run = existing_run(folder, effect_files)
        require_judge(run, "add").check_model(run)
        settings = override(stored_settings(store, run.info), overrides, folder)
        info = dataclasses.replace(
            run.info, effects=change(run.info.effects), pipeline=settings.model_dump_json()
        )
        run = new_run(store, info, effect_files)
        judge = require_judge(run, "add")
        judge.check_model(run)  # before anything is written
        with everything_taken_back(store, info) as under_way:
            if judge.ladder_of_diagnosis:
                _take_ladder(run, effect_files)
            run_stages(run, ("ladder",), show)
            _drop_diagnosis_of_another_model(run)
            under_way.resumable = True
            yield run


def _drop_diagnosis_of_another_model(run: Run) -> None:
    """Without an effect that the diagnosis found in the model, nothing that it says holds."""
    on_top_of = run.store.find("diagnose", ALL, "on_top_of", tuple[str, ...]) or ()
    if not set(on_top_of) <= set(run.info.effects):
        run.store.keep([stage for stage in stages_of(run) if stage != "diagnose"])


def _take_ladder(run: Run, effect_files: tuple[str, ...]) -> None:
    """Take the diagnosis's ladder where it is of just these effects: one model has one error wherever it stands."""
    found = run.store.find("diagnose", ALL, "diagnosis", Diagnosis)
    if found is None or not found.ladder.rungs:
        return
    before = new_run(run.store, dataclasses.replace(run.info, effects=()), effect_files)
    up_to_date = Keys(before, ("diagnose",))("diagnose", ALL) == run.store.key("diagnose", ALL)
    if up_to_date and run.info.effects and found.ladder.rungs[-1].effects == run.info.effects:
        key, settings = Keys(run, ("ladder",))("ladder", ALL), run.settings.ladder.model_dump_json()
        run.store.save("ladder", ALL, key, settings, 0.0, ladder=found.ladder)


def adding(labels: Iterable[str]) -> Callable[[tuple[str, ...]], tuple[str, ...]]:
    """The change that adds effects on top."""

    def change(effects: tuple[str, ...]) -> tuple[str, ...]:
        for label in map(_plain_label, labels):
            if label in effects:
                raise EmaError(f"effect '{label}' is in the model already")
            effects = (*effects, label)
        return effects

    return change


def removing(label: str) -> Callable[[tuple[str, ...]], tuple[str, ...]]:
    """The change that takes one effect away."""
    label = _plain_label(label)

    def change(effects: tuple[str, ...]) -> tuple[str, ...]:
        if label not in effects:
            hint = did_you_mean(label, effects) if effects else ", which has no added effects"
            raise EmaError(f"effect '{label}' is not in the model{hint}")
        return tuple(x for x in effects if x != label)

    return change


def _plain_label(label: str) -> str:
    """An effect's label without blanks, so that it is found again however it was typed."""
    return "@".join(part.strip() for part in label.split("@"))


def _with_decisions_of(store: Store, info: RunInfo) -> RunInfo:
    """Keep the effects added to the same rig in an earlier run, and the choices of hits and modes."""
    before = load_info(store) if store.path.is_file() else None
    if before is None:
        return info
    if before.rig == info.rig:
        info = dataclasses.replace(info, effects=before.effects)
    return dataclasses.replace(info, choices=before.choices.among(info.configurations))


@contextlib.contextmanager
def _tidy(out: Path) -> Iterator[None]:
    """Remove a results folder that this run made, if the run fails before it holds a result."""
    existed = out.exists()
    try:
        yield
    except BaseException:
        if not existed and out.is_dir() and {p.name for p in out.iterdir()} <= {".lock"}:
            (out / ".lock").unlink(missing_ok=True)
            out.rmdir()
        raise
