"""The command ``ema``: its verbs, in the order in which its help lists them, and how it ends."""

from __future__ import annotations

import errno
import inspect
import io
import os
import sys
import traceback
from typing import Annotated, NoReturn, TextIO

import typer

from ema_pipeline import __version__
from ema_pipeline.commands import (
    changes,
    choices,
    compare,
    diagnosis,
    listings,
    merge,
    raw,
    runs,
    series,
    watch,
)
from ema_pipeline.commands.interrupts import INTERRUPTED, answer_ctrl_c
from ema_pipeline.commands.screen import program
from ema_pipeline.crash import write_crash_report
from ema_pipeline.errors import EmaError
from ema_pipeline.files import reason
from ema_pipeline.plain_text import printable

app = typer.Typer(
    name="ema",
    help="From hammer hits to modes, to a fitted model, to the physics that the model is missing.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

STAGE_HELP = {
    "ingest": "Read the raw folder of OUT again: records in SI units.",
    "hits": "Find and judge the hits of OUT.",
    "frf": "Estimate the FRFs of OUT.",
    "modal": "Identify the modes of OUT.",
    "correlate": "Pair and compare the modes and FRFs of OUT with the fitted model.",
}
"""Stages that can be run alone, and what each does."""


_DISK_IS_FULL = {errno.ENOSPC, errno.EDQUOT}


def main() -> None:
    """Entry point: every problem with data or settings is one line on stderr and exit code 1."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # see ema_pipeline.threads
    if os.environ.get("COLUMNS") == "0":  # the width is not known
        del os.environ["COLUMNS"]
    sys.stdout, sys.stderr = _opened(sys.stdout), _opened(sys.stderr)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a character gets its escape
            stream.reconfigure(errors="backslashreplace")
    try:
        _refuse_lost_folder()
        answer_ctrl_c(program())
        _refuse_empty(sys.argv[1:])
        app()
    except EmaError as error:
        _stop(f"ema: {error}", 1)
    except KeyboardInterrupt:
        _end_interrupted()
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            _end_interrupted()
        raise
    except BrokenPipeError:
        os._exit(1)
    except MemoryError:
        _stop("ema: there is not enough memory; close other programs, or analyse fewer records at once", 1)
    except Exception as error:
        refused = _refused_by_system(error)
        if refused is None:
            _stop_for_crash(error)
        where = f"{refused.filename}: " if refused.filename else ""
        _stop(f"ema: {where}{reason(refused)}; check the disk's free space and the folder's rights", 1)


def _opened(stream: TextIO | None) -> TextIO:
    """A standard stream, or one to nowhere where it was closed before the program began, as by a daemon."""
    return open(os.devnull, "w", encoding="utf-8") if stream is None else stream


def _refuse_lost_folder() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise EmaError("the current folder was deleted: change to one that exists") from None


def _refuse_empty(arguments: list[str]) -> None:
    """An empty path would stand for the current folder, which would be read or written to."""
    if "" in arguments:
        before = arguments[: arguments.index("")]
        where = f" after {before[-1]}" if before else ""
        raise EmaError(
            f"the argument{where} is empty, perhaps a variable without a value: state it, or leave it out"
        )


def _refused_by_system(error: Exception) -> OSError | None:
    """What the system refused, also where a library puts an error of its own in place of a full disk's."""
    if isinstance(error, OSError):
        return None if error.errno is None else error
    inner: BaseException | None = error
    while inner is not None and not (isinstance(inner, OSError) and inner.errno in _DISK_IS_FULL):
        inner = inner.__cause__ or inner.__context__
    return inner


def _end_interrupted() -> NoReturn:
    """End with the exit code of an interrupt: Python itself kills its process if the interrupt passed an exec()."""
    sys.stdout.flush()
    os._exit(INTERRUPTED)


def _stop_for_crash(error: Exception) -> NoReturn:
    """End with a crash report; with --verbose the traceback is shown as well."""
    path = write_crash_report(error)
    if "--verbose" in sys.argv or "-v" in sys.argv:
        typer.echo(printable("".join(traceback.format_exception(error))), err=True)
    kept = f"the details are in {path}, please send that file to the developers" if path else "see --verbose"
    _stop(f"ema: a fault in ema itself, not in your data ({type(error).__name__}): {kept}", 1)


def _stop(line: str, code: int) -> NoReturn:
    typer.echo(printable(line), err=True)
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


app.command()(runs.run)
for _name, _help in STAGE_HELP.items():
    app.command(_name, help=_help)(runs.stage_command(_name))
for _verb in (
    runs.fit,
    runs.report,
    raw.check,
    raw.init,
    compare.compare,
    runs.levels,
    diagnosis.diagnose,
    diagnosis.add,
    diagnosis.remove,
    diagnosis.ladder,
    choices.exclude,
    choices.include,
    changes.changes,
    changes.mac,
    merge.merge,
    runs.view,
    runs.export,
    listings.rigs,
    listings.effects,
    listings.model,
    listings.settings,
    listings.reproduce,
    raw.simulate,
    watch.watch,
):
    app.command()(_verb)
app.add_typer(series.series, name="series")


def _flowing(text: str) -> str:
    """A docstring as help that is broken where the screen ends and not where the source does."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in inspect.cleandoc(text).split("\n\n"))


for _command in (*app.registered_commands, *series.series.registered_commands):
    if _command.callback is not None:
        _command.help = _flowing(_command.help or _command.callback.__doc__ or "")


if __name__ == "__main__":
    main()
