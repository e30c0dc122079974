"""Output of the subcommands: results on stdout, progress on stderr."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ema_pipeline.plain_text import printable

if TYPE_CHECKING:
    from ema_pipeline.pipeline import ShowStage
    from ema_pipeline.report.results import RunResults
    from ema_pipeline.run.types import Progress


def show(what: Any) -> None:
    """Show text, or what rich can render; names from files cannot steer the terminal."""
    if isinstance(what, str):
        typer.echo(printable(what))
        return
    from rich.console import Console
    from rich.segment import Segment, Segments

    console = Console(highlight=False, soft_wrap=False)
    # Cleaned only once rendered: before, names cannot be distinguished from the colours that rich puts around them.
    rendered = [Segment(printable(s.text), s.style, s.control) for s in console.render(what)]
    # rendered to fit already, but for commands to copy, which are never cut
    console.print(Segments(rendered), end="", crop=False)


def program() -> str:
    """The command ``ema`` as the user can type it: its bare name where the shell finds it, else its path."""
    called = Path(sys.argv[0])
    found = shutil.which("ema")
    if called.name != "ema" or not called.is_file() or (found and Path(found).samefile(called)):
        return "ema"
    return os.path.relpath(called) if called.is_relative_to(Path.cwd()) else str(called)


def on_folder(verb: str, out: Path, effect_files: Sequence[str] = ()) -> str:
    """A command on a results folder as the user can type it."""
    from ema_pipeline.report.commands import command, typed

    return typed(command(verb, str(out), effect_files=effect_files), program())


def show_json(content: Any) -> None:
    """Show JSON, with every character that could steer a terminal escaped."""
    import json

    text = json.dumps(content, indent=2, ensure_ascii=False)
    typer.echo("".join(c if printable(c) == c else json.dumps(c)[1:-1] for c in text))


def show_summary(results: RunResults, *parts: str) -> None:
    """Show parts of what summary.json holds, as JSON."""
    from ema_pipeline.report.summary_files import finite, summary

    content = finite(summary(results))
    show_json({part: content[part] for part in parts if part in content})


def show_old_diagnosis(results: RunResults, out: Path) -> None:
    """Say that the diagnosis knows nothing of the last change, where that is so, and how to repeat it."""
    if results.diagnosis_is_old:
        again = on_folder("diagnose", out, results.effect_files)
        show(f"The diagnosis is older than the last change; repeat it: {again}")


@contextmanager
def progress(quiet: bool) -> Iterator[ShowStage | None]:
    """Progress on stderr: bars on a terminal, a line per finished stage elsewhere, nothing when quiet."""
    if quiet:
        yield None
    elif not sys.stderr.isatty():
        yield _stage_lines
    else:
        from ema_pipeline.report.listings import progress_bars

        with progress_bars() as show_stage:
            yield partial(_cleaned_stage, show_stage)


def _shown(text: str) -> str:
    """Text that rich shows as it stands, square brackets and all."""
    from rich.markup import escape

    return escape(printable(text))


@contextmanager
def _cleaned_stage(show_stage: ShowStage, label: str) -> Iterator[Progress]:
    with show_stage(_shown(label)) as bar:

        def report_progress(done: float, text: str = "") -> None:
            bar(done, _shown(text))

        yield report_progress


@contextmanager
def _stage_lines(label: str) -> Iterator[Progress]:
    start = time.perf_counter()

    def report_progress(done: float, text: str = "") -> None:
        """Show nothing until the stage is done."""

    yield report_progress
    typer.echo(f"{printable(label)}: {time.perf_counter() - start:.1f} s", err=True)
