"""Screens that show no run: the library of effects, a model's own modes, progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from math import inf
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ema_pipeline.number_text import prefixed

ReportProgress = Callable[[float, str], None]


def effects_list(effects: Sequence[dict[str, Any]]) -> RenderableType:
    """Every effect with what it is, where it can sit, its parameters and its characteristic signs."""
    parts: list[RenderableType] = []
    for effect in effects:
        parameters = "; ".join(
            f"{p['name']} ({p['unit']}): {p['description']}"
            if p["description"]
            else f"{p['name']} ({p['unit']})"
            for p in effect["parameters"]
        )
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
        table.add_column(width=10, no_wrap=True)
        table.add_column(overflow="fold")
        table.add_row("  what", Text(effect["title"]))
        table.add_row("  places", Text(", ".join(effect["places"])))
        table.add_row("  size", Text(parameters))
        table.add_row("  signs", Text(effect["signs"]))
        parts += [Text(effect["id"], style="bold"), table]
    return Group(*parts)


def settings_list(settings: Sequence[dict[str, Any]]) -> RenderableType:
    """Every setting with its default, what it may be, and why."""
    parts: list[RenderableType] = []
    for s in settings:
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 1))
        table.add_column(overflow="fold")
        table.add_row(Text(f"  {s['description']} ({s['values']})"))
        parts += [Text(f"{s['name']} = {setting_text(s['default'])}", style="bold"), table]
    return Group(*parts)


def setting_text(default: Any) -> str:
    """A default as TOML would write it; ``"not set"`` where there is none."""
    return "not set" if default is None else json.dumps(default, ensure_ascii=False)


def model_table(configuration: str, modes: Sequence[dict[str, Any]]) -> RenderableType:
    """The model's own modes."""
    table = Table(title=f"Model, {configuration}", box=box.SIMPLE, title_justify="left")
    table.add_column("mode", justify="right")
    table.add_column("frequency, Hz", justify="right")
    table.add_column("damping, %", justify="right")
    table.add_column("family")
    for number, mode in enumerate(modes, 1):
        damping = 100 * mode["damping_ratio"]
        table.add_row(str(number), f"{mode['frequency_hz']:.2f}", f"{damping:.3f}", mode["family"])
    return table


def parameters_table(parameters: Sequence[dict[str, Any]]) -> RenderableType:
    """A rig's parameters with their tolerances, and how far single parts scatter about them."""
    table = Table(
        title="Parameters of the rig",
        caption="tolerance: 1 σ of the value, free where only data tell it; parts: 1 σ of single parts about it, "
        "– where not stated",
        box=box.SIMPLE,
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("parameter", no_wrap=True)
    for column in ("value", "tolerance", "parts", "range"):
        table.add_column(column, justify="right", no_wrap=True)
    for p in parameters:
        factor, unit = prefixed(p["value"], p["unit"])
        least, most = (f"{factor * bound:.4g}" for bound in (p["min"], inf if p["max"] is None else p["max"]))
        table.add_row(
            p["name"],
            f"{factor * p['value']:.4g} {unit if unit != '1' else ''}".strip(),
            "free" if p["tolerance"] is None else _percent(p["tolerance"]),
            "–" if p["scatter"] is None else _percent(p["scatter"]),
            f"{least} … {most.replace('inf', '∞')}",
        )
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share else "exact"


@contextmanager
def progress_bars() -> Iterator[Callable[[str], AbstractContextManager[ReportProgress]]]:
    """Progress bars on stderr; the function handed out opens one bar."""
    columns = (
        TextColumn("{task.description:20s}"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[now]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:

        @contextmanager
        def show(label: str) -> Iterator[ReportProgress]:
            task = bars.add_task(label, total=1.0, now="")

            def report_progress(done: float, text: str = "") -> None:
                bars.update(task, completed=done, now=text[:30])

            yield report_progress

        yield show
