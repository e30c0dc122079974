"""Model against measurement, and the effects that the model is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Out, Overrides, Quiet
from ema_pipeline.commands.screen import progress, show

if TYPE_CHECKING:
    from ema_pipeline.stages.base import Run


def compare(out: Out, effect_file: EffectFiles = None) -> None:
    """Show where model and measurement part, in units of the measurement's uncertainty."""
    from ema_pipeline.job import run_on
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with progress(False) as show_stage:
        stages = ["correlate", "ladder"] if _of_loops(out) else ["correlate"]
        run, _ = run_on(out, stages, show=show_stage, effect_files=effect_file or [])
    run.require_model("compare")
    if run.info.kind == "hysteresis":
        from ema_pipeline.report.loops import comparison_screen
        from ema_pipeline.stages.loop_ladder import loops_of, own_models

        show(comparison_screen(loops_of(run), own_models(run)))
        return
    comparison = load_results(run).comparison
    assert comparison is not None  # the stage has just run
    show(terminal.comparison_tables(comparison))


def diagnose(
    out: Out,
    auto: Annotated[
        bool, typer.Option("--auto", help="Add what is supported, one effect after the other.")
    ] = False,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Say which physical effect the model is missing, how sure that is, and what to measure next."""
    from ema_pipeline.job import adding, change_effects, run_on
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with progress(quiet) as show_stage:
        run, _ = run_on(out, ["diagnose", "report"], set_ or [], show_stage, effect_file or [])
        run.require_model("diagnose")
        found = load_results(run).diagnosis
        assert found is not None  # the stage has just run
        supported = found.ladder.rungs[-1].effects
        if auto and supported:
            run = change_effects(out, adding(supported), (), show_stage, effect_file or [])
    if quiet:
        return
    show(terminal.diagnosis_screen(found, str(out)))
    if auto and supported:
        _show_ladder(run)


def add(
    out: Out,
    effect: Annotated[list[str], typer.Argument(metavar="EFFECT@PLACE", help="See 'ema effects'.")],
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Add a physical effect to the model, refit, and show the error before and after."""
    from ema_pipeline.job import adding, change_effects

    with progress(quiet) as show_stage:
        run = change_effects(out, adding(effect), set_ or [], show_stage, effect_file or [])
    if not quiet:
        _show_ladder(run)


def remove(
    out: Out,
    effect: Annotated[str, typer.Argument(metavar="EFFECT@PLACE", help="An effect that was added.")],
    effect_file: EffectFiles = None,
    quiet: Quiet = False,
) -> None:
    """Take an added effect out of the model again."""
    from ema_pipeline.job import change_effects, removing

    with progress(quiet) as show_stage:
        run = change_effects(out, removing(effect), (), show_stage, effect_file or [])
    if not quiet:
        _show_ladder(run)


def ladder(out: Out, effect_file: EffectFiles = None) -> None:
    """Show the models so far, each with its error on the data fitted and on data held out."""
    from ema_pipeline.pipeline import existing_run

    _show_ladder(existing_run(out, effect_file or []))


def _of_loops(out: Path) -> bool:
    from ema_pipeline.pipeline import existing_run

    return existing_run(out).info.kind == "hysteresis"


def _show_ladder(run: Run) -> None:
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    results = load_results(run)
    rungs = results.ladder or (None if results.diagnosis is None else results.diagnosis.ladder)
    if rungs is None:
        show(
            f"The model has no added effects. 'ema diagnose {run.store.folder}' says what it may be missing."
        )
    else:
        show(terminal.ladder_screen(rungs))
