"""The command ``ema``: its verbs, in the order in which its help lists them, and how it ends."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from ema_pipeline import __version__
from ema_pipeline.commands import diagnosis, listings, raw, runs
from ema_pipeline.errors import EmaError

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
    "fit": "Fit the model's parameters to the modes of OUT.",
    "correlate": "Pair and compare the modes and FRFs of OUT with the fitted model.",
    "report": "Write the tables, plots and report of OUT.",
}
"""Stages that can be run alone, and what each does."""


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


app.command()(runs.run)
for _name, _help in STAGE_HELP.items():
    app.command(_name, help=_help)(runs.stage_command(_name))
for _verb in (
    raw.check,
    raw.init,
    diagnosis.compare,
    runs.levels,
    diagnosis.diagnose,
    diagnosis.add,
    diagnosis.remove,
    diagnosis.ladder,
    runs.view,
    runs.export,
    listings.rigs,
    listings.effects,
    listings.model,
    listings.reproduce,
    raw.simulate,
):
    app.command()(_verb)


if __name__ == "__main__":
    main()
