"""Everything found → summary.json, modes.csv, report.html and, on demand, plots."""

from __future__ import annotations

import json
from pathlib import Path

from ema_pipeline.run.types import Progress, Run, silent
from ema_pipeline.stages.results import load_results

NAME = "report"
NEEDS: tuple[str, ...] = ()
PER_CONFIGURATION = False
NEEDS_RIG = False
OUTPUTS = ("summary.json", "report.html")


def inputs(run: Run, configuration: str) -> str:
    """Everything that is there, whether the pipeline has all stages or not."""
    keys = {str(at): p.key for at, p in run.store.provenance().items() if at[0] != NAME}
    return json.dumps([keys, run.info.title, run.info.configurations, run.info.rig, run.info.effects])


def work(run: Run, configuration: str, progress: Progress) -> dict[str, object]:
    """Write every file of the results folder but the store."""
    from ema_pipeline.report.html import write_report  # drawing libraries are loaded where they are needed

    folder = run.store.folder
    results = load_results(run, synthesis=False)
    if results.loops is not None:
        from ema_pipeline.report.loops import write_loops_summary

        write_loops_summary(results, results.loops, folder / "summary.json")
    else:
        from ema_pipeline.report.summary_files import write_modes_csv, write_summary

        write_summary(results, folder / "summary.json")
        write_modes_csv(results, folder / "modes.csv")
    write_report(results, folder / "report.html")
    if run.settings.report.plots:
        draw(run, progress)
    return {"files": OUTPUTS}


def draw(run: Run, progress: Progress = silent) -> Path:
    """Draw every figure for print, as PNG and SVG, into the folder ``plots`` beside the store."""
    folder, results = run.store.folder / "plots", load_results(run)
    if results.loops is not None:
        from ema_pipeline.report.loops import write_loops_plots

        write_loops_plots(results, results.loops, folder)
    else:
        from ema_pipeline.report.plots import write_plots

        write_plots(results, folder, lambda k, count, name: progress(0.95 * k / count, name))
    return folder


def paper(run: Run, progress: Progress = silent) -> Path:
    """Write the report for print, ``report.pdf`` beside the store."""
    from ema_pipeline.report.pdf import write_pdf

    path = run.store.folder / "report.pdf"
    write_pdf(load_results(run), path, lambda k, count, name: progress(0.95 * k / count, name))
    return path
