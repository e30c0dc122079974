"""Model against measurement."""

from __future__ import annotations

from ema_pipeline.commands.options import EffectFiles, Json, Out
from ema_pipeline.commands.screen import progress, show, show_json, show_summary


def compare(out: Out, effect_file: EffectFiles = None, json: Json = False) -> None:
    """Show where model and measurement differ, in units of the measurement's uncertainty."""
    from ema_pipeline.job import run_on
    from ema_pipeline.kinds import require_judge, stages_of
    from ema_pipeline.report import terminal
    from ema_pipeline.report.simulation import error_lines
    from ema_pipeline.run.opening import existing_run
    from ema_pipeline.stages.results import load_results

    with progress(False) as show_stage:
        stage = "correlate" if "correlate" in stages_of(existing_run(out)) else "ladder"
        run, _ = run_on(out, [stage], show=show_stage, effect_files=effect_file or [])
    require_judge(run, "compare")
    results = load_results(run)
    if results.loops is not None:
        from ema_pipeline.kinds.loops import own_models
        from ema_pipeline.report.loops import comparison_rows, comparison_screen

        loops, models = results.loops.loops, own_models(run)
        if json:
            show_json({"loops": comparison_rows(loops, models)})
        else:
            show(comparison_screen(loops, models))
    elif results.comparison is not None:
        if json:
            show_summary(results, "comparison")
        else:
            show(terminal.comparison_tables(results.comparison))
    elif json:
        show_summary(results, "simulation")
    else:
        for line in error_lines(results.simulation):
            show(line)
