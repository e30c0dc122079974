"""The effects that the model is missing: found, added, removed, and the ladder of models."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.interrupts import go_on_with
from ema_pipeline.commands.options import EffectFiles, Json, Out, Overrides, Quiet
from ema_pipeline.commands.screen import (
    on_folder,
    program,
    progress,
    show,
    show_old_diagnosis,
    show_summary,
)
from ema_pipeline.errors import EmaError

if TYPE_CHECKING:
    from ema_pipeline.run.types import Run


def diagnose(
    out: Out,
    auto: Annotated[
        bool, typer.Option("--auto", help="Add what is supported, one effect after the other.")
    ] = False,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Say which physical effect the model is missing, how sure that is, and what to measure next."""
    from ema_pipeline.job import adding, change_effects, run_on
    from ema_pipeline.kinds import require_judge
    from ema_pipeline.report import terminal
    from ema_pipeline.report.cautions import suspicions
    from ema_pipeline.stages.results import load_results

    with progress(quiet) as show_stage:
        run, _ = run_on(out, ["diagnose", "report"], set_ or [], show_stage, effect_file or [])
        require_judge(run, "diagnose").check_model(run)
        results = load_results(run)
        if results.not_diagnosed:
            raise EmaError(f"{out}: nothing was diagnosed: {results.not_diagnosed}")
        found = results.diagnosis
        assert found is not None  # the stage has just run
        supported = [x for x in found.ladder.rungs[-1].effects if x not in run.info.effects]
        if auto and supported:
            run = change_effects(out, adding(supported), (), show_stage, effect_file or [])
    if json:
        show_summary(load_results(run), "diagnosis", "ladder")
        return
    if quiet:
        return
    files, added = results.effect_files, run.info.effects
    show(terminal.diagnosis_screen(found, str(out), program(), suspicions(results), files, added))
    if auto and supported:
        _show_ladder(run)


def add(
    out: Out,
    effect: Annotated[list[str], typer.Argument(metavar="EFFECT@PLACE", help="See 'ema effects'.")],
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Add a physical effect to the model, refit, and show the error before and after."""
    from ema_pipeline.job import adding

    _change(out, adding(effect), effect_file or [], set_ or [], quiet, json)


def remove(
    out: Out,
    effect: Annotated[str, typer.Argument(metavar="EFFECT@PLACE", help="An effect that was added.")],
    effect_file: EffectFiles = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Take an added effect out of the model again."""
    from ema_pipeline.job import removing

    _change(out, removing(effect), effect_file or [], [], quiet, json)


def _change(
    out: Path,
    change: Callable[[tuple[str, ...]], tuple[str, ...]],
    effect_files: list[str],
    overrides: list[str],
    quiet: bool,
    json: bool,
) -> None:
    """Change the effects of the model; the ladder is the answer, fit and report follow."""
    from rich.text import Text

    from ema_pipeline.job import AFTER_EFFECTS, changed_effects
    from ema_pipeline.number_text import plain
    from ema_pipeline.pipeline import run_stages
    from ema_pipeline.report.commands import naming
    from ema_pipeline.report.diagnosis import model_words
    from ema_pipeline.stages.results import load_results

    with ExitStack() as under_way:
        with progress(quiet) as show_stage:
            changed = changed_effects(out, change, overrides, show_stage, effect_files)
            run = under_way.enter_context(changed)
        stages = (shlex.join([stage, str(out), *naming(effect_files)]) for stage in AFTER_EFFECTS)
        go_on_with(f" && {program()} ".join(stages))
        # a ladder of what is only proposed would be taken for the model
        if not quiet and not json and run.info.effects:
            _show_ladder(run)
        with progress(quiet) as show_stage:
            run_stages(run, AFTER_EFFECTS, show_stage)
    if json:
        _show_ladder(run, json)
    elif not quiet:
        results = load_results(run, synthesis=False)
        model, report = model_words(results.added), run.store.folder / "report.html"
        told = results.current_rung or results.fit  # as the ladder states it: the fit may bend parts further
        error = "" if told is None else f" (error {plain(told.error, 3)})"
        show(Text(f"Fit, comparison and report now use {model}{error}."))
        show(f"Report: {report}")


def ladder(out: Out, effect_file: EffectFiles = None, json: Json = False) -> None:
    """Show the models so far, each with its error on the data fitted and on data held out."""
    from ema_pipeline.run.opening import existing_run

    _show_ladder(existing_run(out, effect_file or []), json)


def _show_ladder(run: Run, json: bool = False) -> None:
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    results, folder = load_results(run), run.store.folder
    if json:
        show_summary(results, "effects", "ladder")
    elif run.info.effects and results.ladder is not None:
        show(terminal.ladder_screen(results.ladder))
    elif (
        results.diagnosis is not None and len(results.diagnosis.ladder.rungs) > 1 and not results.diagnosed_on
    ):
        show("The model has no added effects. What the diagnosis proposes:")
        show(terminal.ladder_screen(results.diagnosis.ladder))
        show_old_diagnosis(results, folder)
    elif (
        results.diagnosis is not None
        and results.diagnosis.verdict == "adequate"
        and not results.diagnosis_is_old
    ):
        show("The model has no added effects. The diagnosis found nothing missing.")
    else:
        again = on_folder("diagnose", folder, results.effect_files)
        show(f"The model has no added effects. '{again}' says what it may be missing.")
