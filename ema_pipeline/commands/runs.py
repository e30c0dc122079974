"""Runs: from a raw folder to a results folder, stage by stage, and what is taken from there."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ema_pipeline.commands.interrupts import end_by_ctrl_c, go_on_with
from ema_pipeline.commands.options import EffectFiles, Json, Out, Overrides, Quiet, RigOption, Verbose
from ema_pipeline.commands.screen import on_folder, program, progress, show, show_json

if TYPE_CHECKING:
    from ema_pipeline.run.types import Run


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
    json: Json = False,
) -> None:
    """Go from raw hits to modes and, with a rig, to a fitted model. Unchanged stages are skipped."""
    from ema_pipeline.describe import describe_modes
    from ema_pipeline.job import run_raw

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
    if json:
        show_json(_content(result))
    elif not quiet:
        _show_summary(result)
        if not computed:
            show("Nothing had changed: all results are those of the earlier run.")
        elif verbose:
            show(_computed_words(computed))


def _show_summary(done: Run) -> None:
    from ema_pipeline.stages.results import load_results

    results, folder = load_results(done, synthesis=False), done.store.folder
    report = f"Report: {folder / 'report.html'}"
    if results.loops is not None:
        from ema_pipeline.report.loops import run_screen
        from ema_pipeline.stages.results import isolators

        show(run_screen(isolators(done), results, str(folder)))
        show(report)
    else:
        from ema_pipeline.report.run_screen import RunScreen, next_lines

        below = [*(f"Next: {line}" for line in next_lines(results, str(folder), program())), report]
        show(RunScreen(results, str(folder), len(below)))
        for line in below:  # never cropped: they are there to be copied
            show(line)


def _content(done: Run) -> Any:
    """What summary.json holds, or would hold."""
    from ema_pipeline.report.summary_files import finite, summary
    from ema_pipeline.stages.results import load_results

    return finite(summary(load_results(done, synthesis=False)))


def stage_command(name: str) -> Callable[..., None]:
    """The verb that runs one stage on a results folder."""

    def command(
        out: Out,
        effect_file: EffectFiles = None,
        set_: Overrides = None,
        quiet: Quiet = False,
        verbose: Verbose = False,
        json: Json = False,
    ) -> None:
        from ema_pipeline.job import run_on
        from ema_pipeline.kinds import require_stage
        from ema_pipeline.run.opening import existing_run

        require_stage(existing_run(out, effect_file or []), name)
        with progress(quiet) as show_stage:
            run, computed = run_on(out, [name], set_ or [], show_stage, effect_file or [])
        if json:
            show_json(_content(run))
        elif not quiet:
            show(_computed_words(computed))

    return command


def _computed_words(computed: Sequence[str]) -> str:
    return f"Computed: {', '.join(computed)}" if computed else "Nothing had changed."


def fit(
    out: Out,
    save: Annotated[
        Path | None, typer.Option("--save", metavar="RIG.toml", help="Write the fitted model as a rig file.")
    ] = None,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Fit the model's parameters to what was measured in OUT, and show them."""
    from ema_pipeline.export import check_rig_file, save_rig
    from ema_pipeline.job import run_on
    from ema_pipeline.kinds import require_judge, stages_of
    from ema_pipeline.report import terminal
    from ema_pipeline.run.opening import existing_run
    from ema_pipeline.stages.results import load_results

    with progress(quiet) as show_stage:
        # loops and simulated records have no fit of their own: every model of a ladder is one
        known = existing_run(out, effect_file or [])
        stage = "fit" if "fit" in stages_of(known) else "ladder"
        if save is not None:
            check_rig_file(known, save)
        run, computed = run_on(out, [stage], set_ or [], show_stage, effect_file or [])
    require_judge(run, "fit")
    if save is not None:
        save_rig(run, save)
    if json:
        show_json(_content(run))
        return
    if quiet:
        return
    results = load_results(run)
    if results.fit is not None:
        show(terminal.fit_table(results.fit, results.provisional))
    elif results.current_rung is not None:
        show(terminal.rung_table(results.current_rung))
    else:
        again = on_folder("diagnose", out, results.effect_files)
        show(f"The model in use has not been fitted yet; '{again}' does that.")
    if verbose:
        show(_computed_words(computed))
    if save is not None:
        show(f"Wrote {save}; use it with --rig {save}")


def report(
    out: Out,
    plots: Annotated[
        bool, typer.Option("--plots", help="Also draw every figure for print into OUT/plots (PNG, SVG).")
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also write OUT/report.pdf for print, eight pages at most.")
    ] = False,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Write the tables and the report of OUT; on demand also figures and pages for print."""
    from ema_pipeline.export import draw_plots, write_pages
    from ema_pipeline.job import run_on

    with progress(quiet) as show_stage:
        run, _ = run_on(out, ["report"], set_ or [], show_stage, effect_file or [])
        drawn = draw_plots(run, show_stage) if plots else None
        pages = write_pages(run, show_stage) if pdf else None
    if not quiet:
        show(f"Report: {run.store.folder / 'report.html'}")
        if drawn is not None:
            show(f"Plots: {drawn}")
        if pages is not None:
            show(f"Pages: {pages}")


def levels(out: Out, effect_file: EffectFiles = None, set_: Overrides = None, json: Json = False) -> None:
    """Show what moves with the force of the hits: frequency and damping of every mode by force level."""
    from ema_pipeline.job import run_on
    from ema_pipeline.kinds import require_stage
    from ema_pipeline.report import terminal
    from ema_pipeline.run.opening import existing_run
    from ema_pipeline.stages.results import load_results

    require_stage(existing_run(out, effect_file or []), "levels")
    with progress(False) as show_stage:
        run, _ = run_on(out, ["levels", "report"], set_ or [], show_stage, effect_file or [])
    if json:
        show_json({name: c.get("levels") for name, c in _content(run)["configurations"].items()})
        return
    for found in load_results(run).configurations:
        if found.levels is not None and found.modal is not None:
            show(terminal.levels_tables(found.levels, found.modal, found.name))


def view(
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Results folder; or a raw folder whose hits are to be judged."),
    ],
    browser: Annotated[bool, typer.Option(help="Open the page in the web browser.")] = True,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this machine; 0: a free one.")] = 0,
    effect_file: EffectFiles = None,
    point: Annotated[
        list[str] | None,
        typer.Option(
            "--point", metavar="DOF", help="Raw folder: point to strike; in this order, once for each."
        ),
    ] = None,
    hits: Annotated[int, typer.Option(min=1, help="Raw folder: good hits that a point needs.")] = 3,
    poll: Annotated[
        bool, typer.Option("--poll", help="Raw folder: check at intervals, for network shares.")
    ] = False,
) -> None:
    """Open the live page of OUT: add and remove effects and watch the error. It stops with Ctrl-C.

    Of a raw folder it shows what 'ema watch' says: how good each hit was, what to strike next, which points are done.
    """

    def ready(address: str) -> None:
        show(f"The page of {out} is at {address}\nIt is for one browser on this machine; stop with Ctrl-C.")
        if browser and _has_screen():
            typer.launch(address)

    if _is_raw(out):
        from ema_pipeline.view.hits import serve_hits

        go_on_with(f"run {shlex.quote(str(out))}")
        serve_hits(out, point or (), hits, poll, port, ready)
        show(f"Next: {program()} run {shlex.quote(str(out))}")
        return
    from ema_pipeline.report.commands import naming
    from ema_pipeline.store import Store
    from ema_pipeline.view.server import serve
    from ema_pipeline.view.session import Session

    Store.existing(out)
    session = Session(out, effect_file or [])
    # what was changed on the page is kept, but for a change under way
    go_on_with(shlex.join(["view", str(out), *naming(effect_file or [])]))
    end_by_ctrl_c(lambda: "" if session.job else "stopped; all changes are kept")
    serve(session, port, ready)


def _is_raw(folder: Path) -> bool:
    """True for a folder with a test description and without results."""
    from ema_pipeline.ingest.description import DESCRIPTION_FILE
    from ema_pipeline.results_folder import RESULTS_FILE

    return (folder / DESCRIPTION_FILE).is_file() and not (folder / RESULTS_FILE).exists()


def export(
    out: Out,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to",
            metavar="FOLDER",
            help="Folder to write, where no file is replaced. If left out, OUT/export, which is written anew.",
        ),
    ] = None,
    effect_file: EffectFiles = None,
) -> None:
    """Write FRFs, modes and shapes as universal file (58, 55) and CSV for other programs."""
    from ema_pipeline.export import export_results

    for path in export_results(out, to, effect_file or []):
        show(str(path))


def _has_screen() -> bool:
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
