"""Excludes and includes hits and modes: what the user names is looked up and checked, kept, and everything refitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from ema_pipeline.choices import Choices, HitChoice, ModeChoice, split_hit, split_mode
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.ingest.chosen import rejected_by_choice
from ema_pipeline.ingest.records import Hit
from ema_pipeline.kinds import kind_of, stages_of
from ema_pipeline.modal.chosen import REACH, nearest_mode, pole_of_chart
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import counted
from ema_pipeline.pipeline import ShowStage, run_stages
from ema_pipeline.run.measured import modes_of_structure
from ema_pipeline.run.opening import existing_run, new_run
from ema_pipeline.run.rollback import everything_taken_back
from ema_pipeline.run.types import Run
from ema_pipeline.store import Store

BEFORE = ("ingest", "diagnose")
"""Stages that a choice leaves as they are: raw data do not change, and the diagnosis is renewed on demand."""

Change = Callable[[Run], Choices]
"""The choices as they shall be."""


def change_choices(
    folder: Path, change: Change, show: ShowStage | None = None, effect_files: Iterable[str] = ()
) -> Run:
    """Change what is excluded and included, and run again everything that it touches but the diagnosis.

    Parameters
    ----------
    folder : Path
        Results folder.
    change : callable
        `excluding` or `including`.
    show : ShowStage or None
    effect_files : iterable of str
        Python files with the user's own effects.

    Raises
    ------
    EmaError
        For hits and modes that do not exist, and where too little is left to analyse; nothing is changed then.
    """
    effect_files = tuple(effect_files)
    store = Store.existing(folder)
    with store.lock():
        run = existing_run(folder, effect_files)
        kind = kind_of(run.info)
        if "modal" not in kind.measures:
            raise EmaError(f"{folder}: a test of {kind.words} has no hits and no modes to choose")
        info = dataclasses.replace(run.info, choices=change(run))
        run = new_run(store, info, effect_files)
        run.check_effect_files()
        with everything_taken_back(store, info):
            run_stages(run, stages_after(run), show)
    return run


def stages_after(run: Run) -> tuple[str, ...]:
    """Stages that the folder has and that choices touch."""
    there = {stage for stage, _ in run.store.provenance()} | {"ladder"}
    return tuple(s for s in run.settings.stages if s in there & stages_of(run) and s not in BEFORE)


def excluding(hits: Sequence[str] = (), modes: Sequence[str] = ()) -> Change:
    """The change that leaves hits and modes out, or takes an inclusion back.

    Parameters
    ----------
    hits : sequence of str
        ``configuration/file#number``; the number may be left out where a file holds one hit, the configuration where
        there is one.
    modes : sequence of str
        ``configuration:hertz``.
    """

    def change(run: Run) -> Choices:
        choices = run.info.choices
        for text in hits:
            hit = _hit(run, text)
            _require_new(f"hit '{hit}'", hit, run.info.choices.excluded_hits, choices.excluded_hits)
            choices = dataclasses.replace(choices, excluded_hits=(*choices.excluded_hits, hit))
            _require_others(run, choices, hit)
        for text in modes:
            configuration, frequency = split_mode(text, run.info.configurations)
            mine = _near(choices.included_modes, configuration, frequency)
            if mine is not None:
                left = tuple(x for x in choices.included_modes if x is not mine)
                choices = dataclasses.replace(choices, included_modes=left)
                continue
            choice = _mode(run, configuration, frequency)
            _require_new(f"mode '{choice}'", choice, run.info.choices.excluded_modes, choices.excluded_modes)
            choices = dataclasses.replace(choices, excluded_modes=(*choices.excluded_modes, choice))
        _require_modes(run, choices)
        return choices

    return change


def including(hits: Sequence[str] = (), modes: Sequence[str] = ()) -> Change:
    """The change that takes modes in from the stabilisation chart, or takes exclusions back.

    Parameters are those of `excluding`.
    """

    def change(run: Run) -> Choices:
        choices = run.info.choices
        for text in hits:
            choice = _hit(run, text)
            if choice not in choices.excluded_hits:
                reason = _found_hit(run, choice).reason
                why = (
                    f"a check has rejected it ({reason}); the limits are settings"
                    if reason
                    else "it is in use"
                )
                raise EmaError(f"hit '{choice}' was not excluded by you: {why}")
            left = tuple(x for x in choices.excluded_hits if x != choice)
            choices = dataclasses.replace(choices, excluded_hits=left)
        for text in modes:
            configuration, frequency = split_mode(text, run.info.configurations)
            mine = _near(choices.excluded_modes, configuration, frequency)
            if mine is not None:
                rest = tuple(x for x in choices.excluded_modes if x is not mine)
                choices = dataclasses.replace(choices, excluded_modes=rest)
                continue
            if "frf" not in kind_of(run.info).measures:
                raise EmaError(
                    f"{run.store.folder}: a table of modes has no stabilisation chart to take a mode from"
                )
            found = pole_of_chart(_modal(run, configuration), configuration, frequency)
            choices = dataclasses.replace(choices, included_modes=(*choices.included_modes, found))
        return choices

    return change


def _require_new(
    what: str, item: HitChoice | ModeChoice, before: Sequence[object], now: Sequence[object]
) -> None:
    """EmaError for what was excluded `before`, or is among what is excluded `now`."""
    if item in before:
        raise EmaError(f"{what} is excluded already")
    if item in now:
        raise EmaError(f"{what} is named twice; name it once")


def _near(chosen: Sequence[ModeChoice], configuration: str, frequency_hz: float) -> ModeChoice | None:
    """The choice that a frequency names."""
    mine = [x for x in chosen if x.configuration == configuration]
    best = min(mine, key=lambda x: abs(x.frequency_hz - frequency_hz), default=None)
    return (
        best if best is not None and abs(best.frequency_hz - frequency_hz) <= REACH * frequency_hz else None
    )


def _hit(run: Run, text: str) -> HitChoice:
    """The hit that a user names."""
    configuration, file, number = split_hit(text, run.info.configurations)
    mine = [h for h in _hits(run, configuration) if h.file == file]
    if not mine:
        files = sorted({h.file for h in _hits(run, configuration)})
        raise EmaError(f"{configuration}: there is no record '{file}'{did_you_mean(file, files)}")
    if number is None and len(mine) > 1:
        raise EmaError(
            f"{configuration}/{file}: holds {len(mine)} hits; name one, e.g. '{configuration}/{file}#1'"
        )
    wanted = 1 if number is None else number
    if wanted not in {h.number for h in mine}:
        raise EmaError(
            f"{configuration}/{file}: holds {counted(len(mine), 'hit')}, counted from 1; none is number {wanted}"
        )
    return HitChoice(configuration, file, wanted)


def _found_hit(run: Run, choice: HitChoice) -> Hit:
    return next(
        h for h in _hits(run, choice.configuration) if (h.file, h.number) == (choice.file, choice.number)
    )


def _require_others(run: Run, choices: Choices, choice: HitChoice) -> None:
    """A point needs one good hit."""
    gone = {(x.file, x.number) for x in choices.excluded_hits if x.configuration == choice.configuration}
    point = _found_hit(run, choice).impact.point
    left = [
        h
        for h in _hits(run, choice.configuration)
        if h.impact.point == point
        and (h.accepted or rejected_by_choice(h))
        and (h.file, h.number) not in gone
    ]
    if not left:
        raise EmaError(f"hit '{choice}' is the last good one on {point}; a point needs one")


def _require_modes(run: Run, choices: Choices) -> None:
    """A configuration needs one mode."""
    before = run.info.choices
    dropped = [x for x in choices.excluded_modes if x not in before.excluded_modes]
    dropped += [x for x in before.included_modes if x not in choices.included_modes]
    for configuration in run.info.configurations:
        gone = [x for x in dropped if x.configuration == configuration]
        if gone and len(gone) >= len(_modal(run, configuration).modes):
            raise EmaError(
                f"{run.store.folder}: without the mode '{gone[-1]}' no mode of '{configuration}' would be left to fit; "
                "keep one"
            )


def _hits(run: Run, configuration: str) -> tuple[Hit, ...]:
    found = run.store.find("hits", configuration, "hits", tuple[Hit, ...])
    if not found:
        raise EmaError(f"{run.store.folder}: holds no hits of '{configuration}'")
    return found


def _mode(run: Run, configuration: str, frequency_hz: float) -> ModeChoice:
    """The mode of the list that a frequency names."""
    modal = _modal(run, configuration)
    at = nearest_mode(modal, frequency_hz)
    if at is None:
        near = min(modal.modes, key=lambda m: abs(m.frequency_hz - frequency_hz), default=None)
        hint = "" if near is None else f"; the nearest is at {near.frequency_hz:.6g} Hz"
        raise EmaError(f"{configuration}: no mode within {100 * REACH:.0f} % of {frequency_hz:.6g} Hz{hint}")
    mode = modal.modes[at]
    return ModeChoice(configuration, mode.frequency_hz, mode.damping_ratio)


def _modal(run: Run, configuration: str) -> ModalModel:
    if not run.store.key("modal", configuration):
        raise EmaError(
            f"{run.store.folder}: holds no modes of '{configuration}'; run 'ema modal {run.store.folder}'"
        )
    return modes_of_structure(run, configuration)
