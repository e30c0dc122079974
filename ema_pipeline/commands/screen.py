"""What a verb shows: results on stdout, progress on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from ema_pipeline.pipeline import ShowStage
    from ema_pipeline.stages.base import Progress


def show(what: Any) -> None:
    """Show text, or what rich can render."""
    if isinstance(what, str):
        typer.echo(what)
        return
    from rich.console import Console

    Console(highlight=False, soft_wrap=False).print(what)


def show_json(content: Any) -> None:
    """Show JSON."""
    import json

    typer.echo(json.dumps(content, indent=2, ensure_ascii=False))


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
            yield show_stage


@contextmanager
def _stage_lines(label: str) -> Iterator[Progress]:
    start = time.perf_counter()

    def tell(done: float, text: str = "") -> None:
        """Show nothing until the stage is done."""

    yield tell
    typer.echo(f"{label}: {time.perf_counter() - start:.1f} s", err=True)
