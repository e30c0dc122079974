"""Everything found → summary.json, modes.csv, plots and report.html."""

from __future__ import annotations

import json
from typing import cast

from ema_pipeline.report.settings import ReportSettings
from ema_pipeline.stages.base import Progress, Run
from ema_pipeline.stages.loop_ladder import loops_of, models_of
from ema_pipeline.stages.results import isolators, load_results

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
    from ema_pipeline.report.html import write_report
    from ema_pipeline.report.loops import write_loops_report
    from ema_pipeline.report.plots import write_plots
    from ema_pipeline.report.summary_files import write_modes_csv, write_summary

    settings = cast(ReportSettings, run.settings[NAME])
    folder = run.store.folder
    if run.info.kind == "hysteresis":
        found = isolators(run)
        write_loops_report(found, load_results(run), loops_of(run), models_of(run), folder)
        return {"files": OUTPUTS}
    results = load_results(run)
    write_summary(results, folder / "summary.json")
    write_modes_csv(results, folder / "modes.csv")

    def drawn(number: int, count: int, name: str) -> None:
        progress(0.95 * number / count, name)

    plots = write_plots(results, folder / "plots", drawn) if settings.plots else None
    write_report(results, folder / "report.html", plots, drawn)
    return {"files": OUTPUTS}
