"""Runs: from a raw folder to a results folder, stage by stage, and what is taken from there."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Out, Overrides, Quiet, RigOption, Verbose
from ema_pipeline.commands.screen import progress, show

if TYPE_CHECKING:
    from ema_pipeline.stages.base import Run


def run(
    raw: Annotated[
        Path | None, typer.Argument(metavar="RAW", help="Raw folder: test.toml and the record files.")
    ] = None,
    modes: Annotated[
        Path | None, typer.Option("--modes", metavar="FILE", help="A table of modes in place of raw data.")
    ] = None,
    rig: RigOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Results folder; results/<name of RAW> if left out.")
    ] = None,
    pipeline: Annotated[
        str | None, typer.Option("--pipeline", "-p", help="Pipeline: a shipped one's name, or a TOML file.")
    ] = None,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Go from raw hits to modes and, with a rig, to a fitted model. Unchanged stages are skipped."""
    from ema_pipeline.job import describe_modes, run_raw

    source = modes or raw
    if source is None or (modes is not None and raw is not None):
        raise typer.BadParameter("give either RAW or --modes FILE")
    folder = out or Path("results") / (source.stem if modes else source.resolve().name)
    with progress(quiet) as show_stage:
        result, computed = run_raw(
            source,
            rig,
            folder,
            pipeline,
            set_ or [],
            show_stage,
            describe_modes if modes else None,
            effect_file or [],
        )
    if not quiet:
        _show_summary(result)
        if not computed:
            show("Nothing had changed: all results are those of the earlier run.")
        elif verbose:
            show(f"Computed: {', '.join(computed)}")
        show(f"Report: {result.store.folder / 'report.html'}")


def _show_summary(done: Run) -> None:
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    if done.info.kind == "hysteresis":
        from ema_pipeline.report.loops import run_screen
        from ema_pipeline.stages.results import isolators

        show(run_screen(isolators(done), load_results(done), str(done.store.folder)))
        return
    show(terminal.run_summary(load_results(done), str(done.store.folder)))


def stage_command(name: str) -> Callable[..., None]:
    """The verb that runs one stage on a results folder."""

    def command(
        out: Out,
        effect_file: EffectFiles = None,
        set_: Overrides = None,
        quiet: Quiet = False,
        verbose: Verbose = False,
    ) -> None:
        from ema_pipeline.job import run_on

        with progress(quiet) as show_stage:
            _, computed = run_on(out, [name], set_ or [], show_stage, effect_file or [])
        if not quiet:
            show(f"Computed: {', '.join(computed)}" if computed else "Nothing had changed.")

    return command


def levels(out: Out, effect_file: EffectFiles = None, set_: Overrides = None) -> None:
    """Show what moves with the force of the hits: frequency and damping of every mode by force level."""
    from ema_pipeline.job import run_on
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with progress(False) as show_stage:
        run, _ = run_on(out, ["levels", "report"], set_ or [], show_stage, effect_file or [])
    for found in load_results(run).configurations:
        if found.levels is not None and found.modal is not None:
            show(terminal.levels_tables(found.levels, found.modal, found.name))


def view(
    out: Out,
    browser: Annotated[bool, typer.Option(help="Open the report in the web browser.")] = True,
) -> None:
    """Open the report of OUT, or print its path where there is no screen."""
    from ema_pipeline.job import report_path

    path = report_path(out)
    if not (browser and _has_screen() and typer.launch(path.as_uri()) == 0):
        show(str(path))


def export(
    out: Out,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="FOLDER", help="Folder to write; OUT/export if left out.")
    ] = None,
    effect_file: EffectFiles = None,
) -> None:
    """Write FRFs, modes and shapes as universal file (58, 55) and CSV for other programs."""
    from ema_pipeline.job import export_results

    for path in export_results(out, to or out / "export", effect_file or []):
        show(str(path))


def _has_screen() -> bool:
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
