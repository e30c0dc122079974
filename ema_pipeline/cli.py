"""The command ``ema``: parse, call one function, print."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ema_pipeline import __version__
from ema_pipeline.errors import EmaError

if TYPE_CHECKING:
    from ema_pipeline.pipeline import ShowStage
    from ema_pipeline.stages.base import Progress, Run

app = typer.Typer(
    name="ema",
    help="From hammer hits to modes, to a fitted model, to the physics that the model is missing.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Raw = Annotated[Path, typer.Argument(metavar="RAW", help="Raw folder: test.toml and the record files.")]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="Results folder of an earlier run.")]
RigOption = Annotated[
    str | None, typer.Option("--rig", "-r", metavar="RIG", help="Name of a rig, or a rig file (.toml).")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more; show where a bug happened.")]
EffectFiles = Annotated[
    list[str] | None,
    typer.Option("--effect-file", metavar="FILE.py", help="A file with an effect of your own."),
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one setting of the pipeline.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def main() -> None:
    """Entry point: every problem with data or settings is one line on stderr and exit code 1."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # see ema_pipeline.threads
    try:
        app()
    except EmaError as error:
        _stop(f"ema: {error}", 1)
    except KeyboardInterrupt:
        _stop("ema: interrupted; what was finished is kept, the same command goes on from there", 130)
    except BrokenPipeError:
        os._exit(1)
    except Exception as error:
        if "--verbose" in sys.argv or "-v" in sys.argv:
            raise
        kind = type(error).__name__
        _stop(f"ema: unexpected {kind}: {' '.join(str(error).split())}; --verbose shows where", 1)


def _stop(line: str, code: int) -> None:
    typer.echo(line, err=True)
    raise SystemExit(code)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ema {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
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
    from ema_pipeline.job import describe_modes, run_raw, with_effect_files

    source = modes or raw
    if source is None or (modes is not None and raw is not None):
        raise typer.BadParameter("give either RAW or --modes FILE")
    folder = out or Path("results") / (source.stem if modes else source.resolve().name)
    with _progress(quiet) as show:
        changes = with_effect_files((), effect_file or [], set_ or [])
        describe_source = describe_modes if modes else None
        result, computed = run_raw(source, rig, folder, pipeline, changes, show, describe_source)
    if not quiet:
        _print_summary(result)
        if not computed:
            _print("Nothing had changed: all results are those of the earlier run.")
        elif verbose:
            _print(f"Computed: {', '.join(computed)}")
        _print(f"Report: {result.store.folder / 'report.html'}")


def _print_summary(done: Run) -> None:
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    if done.info.kind == "hysteresis":
        from ema_pipeline.report.loops import run_screen
        from ema_pipeline.stages.results import isolators

        _print(run_screen(isolators(done), load_results(done), str(done.store.folder)))
        return
    _print(terminal.run_summary(load_results(done), str(done.store.folder)))


def _stage_command(name: str, help_text: str) -> None:
    """Add the command that runs one stage on a results folder."""

    @app.command(name, help=help_text)
    def command(
        out: Out,
        set_: Overrides = None,
        quiet: Quiet = False,
        verbose: Verbose = False,
    ) -> None:
        from ema_pipeline.job import run_on

        with _progress(quiet) as show:
            _, computed = run_on(out, [name], set_ or [], show)
        if not quiet:
            _print(f"Computed: {', '.join(computed)}" if computed else "Nothing had changed.")


_stage_command("ingest", "Read the raw folder of OUT again: records in SI units.")
_stage_command("hits", "Find and judge the hits of OUT.")
_stage_command("frf", "Estimate the FRFs of OUT.")
_stage_command("modal", "Identify the modes of OUT.")
_stage_command("fit", "Fit the model's parameters to the modes of OUT.")
_stage_command("correlate", "Pair and compare the modes and FRFs of OUT with the fitted model.")
_stage_command("report", "Write the tables, plots and report of OUT.")


@app.command()
def check(raw: Raw) -> None:
    """Judge every hit of a raw folder: value, limit and clause of each check."""
    from ema_pipeline.job import check_raw
    from ema_pipeline.report import terminal

    for name, hits in check_raw(raw).items():
        _print(terminal.verdict_table(hits, name))
        _print(terminal.hits_table(hits, name))


@app.command()
def init(raw: Raw) -> None:
    """Draft test.toml from what the record files say."""
    from ema_pipeline.ingest.draft import write_drafts

    for path in write_drafts(raw):
        _print(f"Wrote {path}; look for the lines marked CHECK, then: ema check {raw}")


@app.command()
def compare(out: Out) -> None:
    """Show where model and measurement part, in units of the measurement's uncertainty."""
    from ema_pipeline.job import run_on
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with _progress(False) as show:
        run, _ = run_on(out, ["correlate", "ladder"] if _of_loops(out) else ["correlate"], show=show)
    run.require_model("compare")
    if run.info.kind == "hysteresis":
        from ema_pipeline.report.loops import comparison_screen
        from ema_pipeline.stages.loop_ladder import loops_of, own_models

        _print(comparison_screen(loops_of(run), own_models(run)))
        return
    comparison = load_results(run).comparison
    assert comparison is not None  # the stage has just run
    _print(terminal.comparison_tables(comparison))


@app.command()
def levels(out: Out, set_: Overrides = None) -> None:
    """Show what moves with the force of the hits: frequency and damping of every mode by force level."""
    from ema_pipeline.job import run_on
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with _progress(False) as show:
        run, _ = run_on(out, ["levels", "report"], set_ or [], show)
    for found in load_results(run).configurations:
        if found.levels is not None and found.modal is not None:
            _print(terminal.levels_tables(found.levels, found.modal, found.name))


@app.command()
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
    from ema_pipeline.job import adding, change_effects, run_on, with_effect_files
    from ema_pipeline.pipeline import existing_run
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    with _progress(quiet) as show:
        changes = with_effect_files(existing_run(out).effect_files, effect_file or [], set_ or [])
        run, _ = run_on(out, ["diagnose", "report"], changes, show)
        run.require_model("diagnose")
        found = load_results(run).diagnosis
        assert found is not None  # the stage has just run
        supported = found.ladder.rungs[-1].effects
        if auto and supported:
            run = change_effects(out, adding(supported), (), show)
    if quiet:
        return
    _print(terminal.diagnosis_screen(found, str(out)))
    if auto and supported:
        _print_ladder(run)


@app.command()
def add(
    out: Out,
    effect: Annotated[list[str], typer.Argument(metavar="EFFECT@PLACE", help="See 'ema effects'.")],
    effect_file: EffectFiles = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Add a physical effect to the model, refit, and show the error before and after."""
    from ema_pipeline.job import adding, change_effects, with_effect_files
    from ema_pipeline.pipeline import existing_run

    with _progress(quiet) as show:
        changes = with_effect_files(existing_run(out).effect_files, effect_file or [], set_ or [])
        run = change_effects(out, adding(effect), changes, show)
    if not quiet:
        _print_ladder(run)


@app.command()
def remove(
    out: Out,
    effect: Annotated[str, typer.Argument(metavar="EFFECT@PLACE", help="An effect that was added.")],
    quiet: Quiet = False,
) -> None:
    """Take an added effect out of the model again."""
    from ema_pipeline.job import change_effects, removing

    with _progress(quiet) as show:
        run = change_effects(out, removing(effect), (), show)
    if not quiet:
        _print_ladder(run)


@app.command()
def ladder(out: Out) -> None:
    """Show the models so far, each with its error on the data fitted and on data held out."""
    from ema_pipeline.pipeline import existing_run

    _print_ladder(existing_run(out))


def _of_loops(out: Path) -> bool:
    from ema_pipeline.pipeline import existing_run

    return existing_run(out).info.kind == "hysteresis"


def _print_ladder(run: Run) -> None:
    from ema_pipeline.report import terminal
    from ema_pipeline.stages.results import load_results

    results = load_results(run)
    rungs = results.ladder or (None if results.diagnosis is None else results.diagnosis.ladder)
    if rungs is None:
        _print(
            f"The model has no added effects. 'ema diagnose {run.store.folder}' says what it may be missing."
        )
    else:
        _print(terminal.ladder_screen(rungs))


@app.command()
def view(
    out: Out,
    browser: Annotated[bool, typer.Option(help="Open the report in the web browser.")] = True,
) -> None:
    """Open the report of OUT, or print its path where there is no screen."""
    from ema_pipeline.job import report_path

    path = report_path(out)
    if not (browser and _has_screen() and typer.launch(path.as_uri()) == 0):
        _print(str(path))


@app.command()
def export(
    out: Out,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="FOLDER", help="Folder to write; OUT/export if left out.")
    ] = None,
) -> None:
    """Write FRFs, modes and shapes as universal file (58, 55) and CSV for other programs."""
    from ema_pipeline.job import export_results

    for path in export_results(out, to or out / "export"):
        _print(str(path))


@app.command()
def rigs() -> None:
    """List the rigs that ship with the program."""
    from ema_pipeline.rigs import rig_kinds

    for name, kind in rig_kinds().items():
        _print(f"{name:12s} {kind.title}")


@app.command()
def effects(rig: RigOption = None, json: Json = False) -> None:
    """List the physical effects that a model may be missing, with places, parameters and signs."""
    from ema_pipeline.job import list_effects
    from ema_pipeline.report.listings import effects_list

    listed = list_effects(rig or "planetary")
    if json:
        _print_json({"effects": listed})
    else:
        _print(effects_list(listed))


@app.command()
def model(
    rig: Annotated[str, typer.Option("--rig", "-r", metavar="RIG", help="Name of a rig, or a rig file.")],
    configuration: Annotated[
        str | None, typer.Option("--configuration", "-c", help="Configuration; all if left out.")
    ] = None,
    json: Json = False,
) -> None:
    """Show the modes of the model itself."""
    from ema_pipeline.job import list_model_modes
    from ema_pipeline.report.listings import model_table

    listed = list_model_modes(rig, configuration)
    if json:
        first = next(iter(listed.values()))
        _print_json({"modes": first, "configurations": listed} if len(listed) > 1 else {"modes": first})
    else:
        for name, modes in listed.items():
            _print(model_table(name, modes))


@app.command()
def reproduce(
    which: Annotated[
        str | None, typer.Argument(help="planetary, gearbox or isolator; all if left out.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the figures; none are drawn if left out.")
    ] = None,
) -> None:
    """Compute the tables and figures of the source papers anew, beside what they print."""
    from ema_pipeline.reproduce import NAMES, terminal_text
    from ema_pipeline.reproduce import reproduce as compute

    for name in (which,) if which else NAMES:
        _print(terminal_text(compute(name, out)))


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(metavar="RAW", help="Folder to write.")],
    rig: Annotated[str, typer.Option("--rig", "-r", metavar="RIG", help="Rig, or a rig file.")] = "planetary",
    configuration: Annotated[
        list[str] | None, typer.Option("--configuration", "-c", help="Configuration; all if left out.")
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", "-e", metavar="ID@PLACE:NAME=VALUE", help="Hidden effect and its size."),
    ] = None,
    effect_file: EffectFiles = None,
    value: Annotated[
        list[str] | None, typer.Option("--value", metavar="NAME=VALUE", help="True value of a parameter.")
    ] = None,
    sensor: Annotated[list[str] | None, typer.Option("--sensor", help="DOF of a sensor.")] = None,
    impact: Annotated[list[str] | None, typer.Option("--impact", help="DOF that is struck.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Setting of the test, e.g. sample_rate_hz=25600."),
    ] = None,
    format_: Annotated[str, typer.Option("--format", help="uff, csv, hdf5, mat, wav or tdms.")] = "uff",
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Simulate a hammer test of a rig and write it as a raw folder."""
    from ema_pipeline.job import simulate_raw

    made = simulate_raw(
        out,
        rig,
        configurations=configuration or [],
        effects=effect or [],
        effect_files=effect_file or [],
        values=value or [],
        sensors=sensor or [],
        impacts=impact or [],
        settings=[*(set_ or []), f"format={format_}", f"seed={seed}"],
    )
    if not quiet:
        where = ", ".join(made.configurations)
        _print(f"Wrote {made.records} records ({where}) to {out}; the truth is in {out / 'truth.json'}")


def _has_screen() -> bool:
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def _print(what: Any) -> None:
    if isinstance(what, str):
        typer.echo(what)
        return
    from rich.console import Console

    Console(highlight=False, soft_wrap=False).print(what)


def _print_json(content: Any) -> None:
    import json

    typer.echo(json.dumps(content, indent=2, ensure_ascii=False))


@contextmanager
def _progress(quiet: bool) -> Iterator[ShowStage | None]:
    """Progress on stderr: bars on a terminal, a line per finished stage elsewhere, nothing when quiet."""
    if quiet:
        yield None
    elif not sys.stderr.isatty():
        yield _stage_lines
    else:
        from ema_pipeline.report.listings import progress_bars

        with progress_bars() as show:
            yield show


@contextmanager
def _stage_lines(label: str) -> Iterator[Progress]:
    start = time.perf_counter()

    def tell(done: float, text: str = "") -> None:
        """Show nothing until the stage is done."""

    yield tell
    typer.echo(f"{label}: {time.perf_counter() - start:.1f} s", err=True)


if __name__ == "__main__":
    main()
