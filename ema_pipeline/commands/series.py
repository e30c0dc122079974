"""Many tests: ``ema series run`` and what is made of its table."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.interrupts import go_on_with
from ema_pipeline.commands.options import EffectFiles, Json, Overrides, Quiet, RigOption
from ema_pipeline.commands.screen import program, show, show_json
from ema_pipeline.number_text import counted
from ema_pipeline.plain_text import printable

if TYPE_CHECKING:
    from pandas import DataFrame

    from ema_pipeline.series.database import SeriesDatabase
    from ema_pipeline.series.rows import TestRow
    from ema_pipeline.series.run import SeriesRun, Watch

series = typer.Typer(
    help="Many tests: run, limits, judge, compare, trend, report, export.", no_args_is_help=True
)

Series = Annotated[Path, typer.Argument(metavar="S", help="Folder of a series, from 'ema series run'.")]
_EVERY_S = 10.0
"""Time between two lines of progress where there is no terminal."""


@series.command()
def run(
    tree: Annotated[Path, typer.Argument(metavar="TREE", help="Folder with the raw folders of all tests.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="S", help="Folder of the series.")],
    rig: RigOption = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Processes; one per processor if left out.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler, e.g. tcp://host:8786."),
    ] = None,
    pipeline: Annotated[
        str | None, typer.Option("--pipeline", "-p", help="Pipeline: a shipped one's name, or a TOML file.")
    ] = None,
    parquet: Annotated[bool, typer.Option("--parquet", help="Write the tables as Parquet too.")] = False,
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run every raw folder under TREE, and keep a table of all in S/series.db and S/tests.csv.

    A test that fails is a row with its reason; unchanged tests are skipped; a killed series resumes where it stopped.
    """
    from ema_pipeline.series.database import SeriesDatabase
    from ema_pipeline.series.export import export_series
    from ema_pipeline.series.run import run_series

    go_on_with(shlex.join(sys.argv[1:]))
    with _progress(quiet or json) as watch:
        done = run_series(
            tree,
            out,
            rig,
            jobs=jobs or os.cpu_count() or 1,
            scheduler=scheduler,
            pipeline=pipeline,
            overrides=set_ or [],
            effect_files=effect_file or [],
            watch=watch,
        )
    database = SeriesDatabase.existing(out)
    export_series(database, out)
    if parquet:
        export_series(database, out, parquet=True)
    if json:
        from dataclasses import asdict

        from ema_pipeline.report.summary_files import finite

        show_json(finite(asdict(done) | {"folder": str(out)}))
    elif not quiet:
        _show_run(done, database.table("tests"))
    database.close()


def _show_run(done: SeriesRun, tests: DataFrame) -> None:
    from ema_pipeline.series.database import rows_of
    from ema_pipeline.series.screens import verdict_counts

    show(
        f"{counted(done.found, 'test')}: {done.computed} run, {done.skipped} unchanged, {done.failed} without results."
    )
    if done.computed:
        grown = "" if done.growth != done.growth else f", last tenth {done.growth:.2f} times the first tenth"
        show(
            f"Took {done.seconds:.0f} s; {done.seconds_per_test:.1f} s of processor time per test{grown}; "
            f"this process used {done.driver_mb:.0f} MB, {done.driver_growth_mb:.0f} MB more than at the start."
        )
    show(verdict_counts(tests))
    for row in rows_of(tests[tests["state"] != "ok"].head(10)):
        show(f"  {row.test}: {row.reason}")
    show(f"Table: {done.folder / 'series.db'}, {done.folder / 'tests.csv'}")
    show(f"Next: {program()} series report {shlex.quote(str(done.folder))}")


@contextmanager
def _progress(quiet: bool) -> Iterator[Watch]:
    """A bar on a terminal, a line every few seconds elsewhere; both with the time left."""
    start = last = time.monotonic()
    failed = 0

    def words(done: int, total: int) -> str:
        left = (time.monotonic() - start) / done * (total - done)
        return f"{done} of {counted(total, 'test')}, {failed} failed, {_duration(left)} left"

    if quiet:
        yield lambda done, total, row: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        columns = BarColumn(), TextColumn("{task.fields[now]}")
        # No thread that draws: workers are forked from this process.
        with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as bars:
            bar = bars.add_task("", total=1.0, now="")

            def draw(done: int, total: int, row: TestRow) -> None:
                nonlocal failed
                failed += row.test["state"] != "ok"
                bars.update(bar, completed=done / total, now=words(done, total), refresh=True)

            yield draw
    else:

        def line(done: int, total: int, row: TestRow) -> None:
            nonlocal failed, last
            failed += row.test["state"] != "ok"
            if time.monotonic() - last > _EVERY_S or done == total:
                last = time.monotonic()
                typer.echo(printable(words(done, total)), err=True)

        yield line


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


Reference = Annotated[
    str | None,
    typer.Option(
        "--reference", metavar="TEST", help="Test that numbers the modes; one that is like most if left out."
    ),
]


@contextmanager
def _opened(folder: Path) -> Iterator[SeriesDatabase]:
    from ema_pipeline.series.database import SeriesDatabase

    database = SeriesDatabase.existing(folder)
    try:
        yield database
    finally:
        database.close()


@series.command()
def limits(
    s: Series,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="FILE", help="S/limits.toml if left out.")
    ] = None,
    tests: Annotated[
        list[str] | None,
        typer.Option(
            "--test",
            metavar="TEST",
            help="A test of the good lot; all without a finding if left out. May be repeated.",
        ),
    ] = None,
    content: Annotated[float, typer.Option(help="Share of good tests within all limits together.")] = 0.95,
    confidence: Annotated[float, typer.Option(help="Confidence of that.")] = 0.95,
    reference: Reference = None,
    json: Json = False,
) -> None:
    """Learn limits from a good lot, as normal tolerance intervals; edit the file as you like."""
    from ema_pipeline.series.acceptance_limits import good_lot, learn_limits, write_limits
    from ema_pipeline.series.features import features_of, modes_of_tests, reference_of

    with _opened(s) as database:
        lot = good_lot(database.table("tests"), tests or ())
        modes = {name: m for name, m in modes_of_tests(database).items() if name in lot}
        numbers = reference_of(database, modes, reference)
        parameters = database.table("parameters")
        features = features_of(modes, modes[numbers], parameters[parameters["test"].isin(lot)])
    found, notes = learn_limits(features, modes[numbers], content, confidence, str(s))
    path = to or s / "limits.toml"
    write_limits(found, path, notes)
    if json:
        show_json(found.model_dump(mode="json", by_alias=True) | {"notes": notes})
        return
    for text in notes:
        show(f"Note: {text}")
    show(
        f"Limits of {counted(len(found.modes), 'mode')} and {counted(len(found.parameters), 'parameter')} from "
        f"{counted(found.lot, 'test')}: "
        f"{100 * content:g} % of good tests within all of them, with {100 * confidence:g} % confidence."
    )
    show(f"Wrote {path}; judge with: {program()} series judge {s} --limits {path}")


@series.command()
def judge(
    s: Series,
    limits: Annotated[
        Path | None, typer.Option("--limits", metavar="FILE", help="S/limits.toml if left out.")
    ] = None,
    confidence: Annotated[float, typer.Option(min=0.5, max=0.9999, help="Of each value's interval.")] = 0.95,
    json: Json = False,
) -> None:
    """Judge every test: pass, fail, or undecided where a value's own interval holds a limit."""
    from dataclasses import asdict

    from ema_pipeline.report.summary_files import finite
    from ema_pipeline.series.acceptance_limits import read_limits
    from ema_pipeline.series.judge import judge_series
    from ema_pipeline.series.screens import judged_counts, judged_table

    with _opened(s) as database:
        judged = judge_series(database, read_limits(limits or s / "limits.toml"), confidence)
    if json:
        content = [
            asdict(j)
            | {
                "values": [
                    asdict(v) | {"limits": v.limits.model_dump(include={"min", "max"})} for v in j.values
                ]
            }
            for j in judged
        ]
        show_json(finite({"tests": content}))
        return
    show(judged_table(judged))
    show(judged_counts(judged))


@series.command()
def compare(s: Series, reference: Reference = None, json: Json = False) -> None:
    """Show how the tests scatter, beside the uncertainty of one test, and which values stand out."""
    from ema_pipeline.report.summary_files import finite
    from ema_pipeline.series.compare import compare_tests
    from ema_pipeline.series.features import features_of_series
    from ema_pipeline.series.screens import comparison_table, outlier_table, verdict_counts

    with _opened(s) as database:
        features, numbers = features_of_series(database, reference)
        tests = database.table("tests")
    found = compare_tests(features)
    if json:
        table = found.table.reset_index().to_dict("records")
        show_json(
            finite({"reference": numbers, "features": table, "outliers": found.outliers.to_dict("records")})
        )
        return
    show(comparison_table(found))
    show(outlier_table(found) if len(found.outliers) else "No value stands out.")
    show(verdict_counts(tests))
    show(f"Modes have the numbers of test {numbers}.")


@series.command()
def trend(
    s: Series,
    by: Annotated[
        str | None, typer.Option("--by", metavar="date|serial|name", help="Order of the tests.")
    ] = None,
    reference: Reference = None,
    json: Json = False,
) -> None:
    """Show what drifts or steps along the series, and what lies outside a control chart."""
    from ema_pipeline.report.summary_files import finite
    from ema_pipeline.series.features import features_of_series
    from ema_pipeline.series.screens import trend_json, trend_table
    from ema_pipeline.series.trend import LEVEL, order_of, trends_of

    if by not in (None, "date", "serial", "name"):
        raise typer.BadParameter("give date, serial or name", param_hint="--by")
    with _opened(s) as database:
        order = order_of(database.table("tests"), by)
        features, numbers = features_of_series(database, reference)
    found = trends_of(features, order)
    if json:
        show_json(finite(trend_json(found, order)))
        return
    if not found:
        show("Too few tests for a trend: six or more are needed.")
        return
    show(trend_table(found, order))
    show(
        f"Drifts and steps are reported at p < {LEVEL:g} over all features together (Holm); control limits: mean ± "
        f"2.66 mean moving ranges (ISO 7870-2). Modes have the numbers of test {numbers}."
    )


@series.command()
def report(
    s: Series,
    limits: Annotated[
        Path | None, typer.Option("--limits", metavar="FILE", help="S/limits.toml if it is there.")
    ] = None,
    reference: Reference = None,
    quiet: Quiet = False,
) -> None:
    """Write one page: a table that sorts and filters, distributions, outliers, links to each test's report."""
    from ema_pipeline.series.acceptance_limits import read_limits
    from ema_pipeline.series.page import write_page

    file = limits or s / "limits.toml"
    with _opened(s) as database:
        path = write_page(database, read_limits(file) if limits or file.is_file() else None, reference)
    if not quiet:
        show(f"Report: {path}")


@series.command()
def export(
    s: Series,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to", metavar="FOLDER", help="Folder to write, no file there is replaced; S if left out."
        ),
    ] = None,
    parquet: Annotated[bool, typer.Option("--parquet", help="Parquet in place of CSV.")] = False,
) -> None:
    """Write the tables of a series as CSV or Parquet."""
    from ema_pipeline.series.export import export_series

    with _opened(s) as database:
        for path in export_series(database, to or s, parquet, keep=to is not None):
            show(str(path))
