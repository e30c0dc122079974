"""``ema merge``: several set-ups of one state as one test."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ema_pipeline.commands.options import Json, Quiet
from ema_pipeline.commands.screen import program, progress, show, show_json

if TYPE_CHECKING:
    from rich.table import Table as Screen

    from ema_pipeline.merge import Merged


def merge(
    tests: Annotated[
        list[Path], typer.Argument(metavar="A B …", help="Raw folders, or results folders, of one test each.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="New raw folder.")],
    tolerance: Annotated[
        float,
        typer.Option(
            min=0,
            max=0.1,
            help="1 σ by which frequencies of one state differ between set-ups, relative.",
        ),
    ] = 1e-3,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Merge several set-ups of one state (soft and hard tip, roving sensors) into one raw folder.

    Each part is used in the band of its force spectrum; where bands overlap, FRFs are averaged with the
    inverse of their variances. Parts that are not of one state, or that contradict each other, are refused.
    """
    from ema_pipeline.merge import merge as merge_tests

    with progress(quiet) as show_stage:
        merged = merge_tests(tests, out, tolerance, show_stage)
    if json:
        show_json(_content(merged))
    elif not quiet:
        show(_table(merged))
        for line in _lines(merged):
            show(line)
        show(f"Next: {program()} run {shlex.quote(str(out))}")


def _table(merged: Merged) -> Screen:
    from rich import box
    from rich.table import Table as Screen

    from ema_pipeline.number_text import plain

    table = Screen(box=box.SIMPLE)
    for name in ("part", "band, Hz", "points", "sensors", "modes"):
        table.add_column(name, justify="left" if name == "part" else "right")
    for p in merged.parts:
        low, high = (plain(v) for v in p.band_hz)
        table.add_row(
            p.name, f"{low} to {high}", str(len(p.frfs.inputs)), str(len(p.frfs.outputs)), str(len(p.modes))
        )
    return table


def _lines(merged: Merged) -> list[str]:
    import math

    from ema_pipeline.number_text import format_percent, plain

    low, high = (plain(v) for v in merged.frfs.band_hz)
    pairs = int((merged.frfs.hits > 0).sum())
    lines = [f"Together: {low} to {high} Hz, {pairs} FRFs."]
    known = [m for m in merged.modes if math.isfinite(m.std)]
    if known:
        worst = min(known, key=lambda m: m.p)
        lines.append(
            f"Same state: {len(known)} modes in common, the most different at {worst.frequency_a:.5g} Hz "
            f"({format_percent(worst.change, worst.std)}, p = {worst.p:.2g})."
        )
    else:
        lines.append(
            "Whether the parts are of one state could not be checked, because they have no mode "
            "in common; make sure of it."
        )
    for (a, b), (value, std) in merged.gains.items():
        ratio = format_percent(math.expm1(-value), std)
        lines.append(
            f"Where both measured the same, FRFs of '{b}' differ by {ratio} from '{a}'; the run corrects this."
        )
    return lines


def _content(merged: Merged) -> dict[str, Any]:
    from dataclasses import asdict

    from ema_pipeline.report.summary_files import finite

    return dict(
        finite(
            {
                "folder": str(merged.folder),
                "band_hz": list(merged.frfs.band_hz),
                "parts": [
                    {
                        "name": p.name, "raw": str(p.raw), "band_hz": list(p.band_hz), "modes": len(p.modes),
                        "inputs": [d.point for d in p.frfs.inputs], "outputs": [d.point for d in p.frfs.outputs],
                    }
                    for p in merged.parts
                ],
                "common_modes": [asdict(m) for m in merged.modes],
                "gains": [
                    {"a": a, "b": b, "ln_ratio": value, "std": std} for (a, b), (value, std) in merged.gains.items()
                ],
            }
        )
    )  # fmt: skip
