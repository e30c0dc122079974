"""Hits and modes that are left out, or taken in, by hand."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Json, Out, Quiet
from ema_pipeline.commands.screen import progress, show, show_json, show_old_diagnosis

if TYPE_CHECKING:
    from ema_pipeline.choosing import Change

Hits = Annotated[
    list[str] | None,
    typer.Option(
        "--hit",
        metavar="CONFIGURATION/FILE#NUMBER",
        help="A hit, as the report's table of hits names it. May be repeated.",
    ),
]
Modes = Annotated[
    list[str] | None,
    typer.Option(
        "--mode",
        metavar="CONFIGURATION:HERTZ",
        help="A mode, by about its frequency (within 1 %). May be repeated.",
    ),
]


def exclude(
    out: Out,
    hit: Hits = None,
    mode: Modes = None,
    effect_file: EffectFiles = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Leave hits or modes out, refit, and show what that changes. 'ema include' takes it back; raw data stay."""
    from ema_pipeline.choosing import excluding

    _require(hit, mode)
    _change(out, excluding(hit or (), mode or ()), effect_file or [], quiet, json)


def include(
    out: Out,
    hit: Hits = None,
    mode: Modes = None,
    effect_file: EffectFiles = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Take a mode in from the stabilisation chart, or what was excluded, refit, and show what that changes."""
    from ema_pipeline.choosing import including

    _require(hit, mode)
    _change(out, including(hit or (), mode or ()), effect_file or [], quiet, json)


def _require(hits: list[str] | None, modes: list[str] | None) -> None:
    if not hits and not modes:
        raise typer.BadParameter("name at least one --hit or --mode")


def _change(out: Path, change: Change, effect_files: list[str], quiet: bool, json: bool) -> None:
    """Change the choices, and print modes and errors before and after."""
    from ema_pipeline.choosing import change_choices
    from ema_pipeline.report import terminal
    from ema_pipeline.report.moved_modes import error_words, moved_table, seen, still_words
    from ema_pipeline.report.summary_files import choices_summary, finite
    from ema_pipeline.run.opening import existing_run
    from ema_pipeline.stages.results import load_results

    before = seen(load_results(existing_run(out, effect_files)))
    with progress(quiet) as show_stage:
        run = change_choices(out, change, show_stage, effect_files)
    results = load_results(run)
    after = seen(results)
    if json:
        content = {
            "choices": choices_summary(results.choices),
            "before": asdict(before),
            "after": asdict(after),
        }
        show_json(finite(content))
        return
    if quiet:
        return
    table, unmoved = moved_table(before, after), still_words(before, after)
    if table.rows:
        show(terminal.text_table(table, "Modes before and after"))
    if unmoved:
        show(unmoved)
    show(error_words(before, after) or "Nothing has changed.")
    show_old_diagnosis(results, out)
