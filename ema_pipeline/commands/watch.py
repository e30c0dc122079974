"""``ema watch``: hits judged during the test."""

from __future__ import annotations

import shlex
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.interrupts import go_on_with
from ema_pipeline.commands.screen import program, show

if TYPE_CHECKING:
    from ema_pipeline.watch.session import Told


def watch(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Raw folder that the analyser writes to, with a test.toml."),
    ],
    point: Annotated[
        list[str] | None,
        typer.Option("--point", metavar="DOF", help="Point to strike; in this order, once for each."),
    ] = None,
    hits: Annotated[int, typer.Option(min=1, help="Good hits that a point needs.")] = 3,
    poll: Annotated[bool, typer.Option("--poll", help="Check at intervals, for network shares.")] = False,
    sound: Annotated[
        bool, typer.Option("--sound", help="Beep once for a good hit, twice for a bad one.")
    ] = False,
    idle: Annotated[
        float, typer.Option(min=0, help="Stop after this many seconds without a new file; 0: never.")
    ] = 0.0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
) -> None:
    """Judge every hit as its file arrives: overload, double hit, force, coherence so far, reversed or dead channel.

    Each file gets one line within a second: good or not, why, and what to strike next. New files are listed in
    test.toml, so that FOLDER is ready for 'ema run'. Files that are there already come first. It stops with Ctrl-C.
    """
    from ema_pipeline.errors import EmaError
    from ema_pipeline.watch.live import judged_files
    from ema_pipeline.watch.session import Session

    if not folder.is_dir():
        raise EmaError(f"{folder}: there is no such folder; give the folder that the analyser writes to")
    session = Session(folder, point or (), hits)
    go_on_with(f"run {shlex.quote(str(folder))}")
    if not json:
        first = f"; strike {session.next_point} first" if session.next_point else ""
        show(f"Watching {folder}, {hits} good hits per point{first}. Stop with Ctrl-C.")
    last = time.monotonic()
    for told in judged_files(session, poll):
        if told is not None:
            last = time.monotonic()
            _show_verdict(told, json)
            if sound:
                typer.echo("\a" * (1 if told.good else 2), nl=False, err=True)
        elif idle and time.monotonic() - last > idle:
            break
    if not json:
        missing = session.missing()
        if missing:
            show(f"Listed in test.toml, but missing: {', '.join(missing)}; remove them before the run.")
        left = [
            f"{p.point} ({p.good} of {p.wanted} good hits)" for p in session.states() if p.good < p.wanted
        ]
        if left:
            show(f"Still to strike: {', '.join(left)}.")
        show(f"Next: {program()} run {shlex.quote(str(folder))}")


def _show_verdict(told: Told, json: bool) -> None:
    if not json:
        show(told.text)
        return
    from json import dumps

    from ema_pipeline.report.summary_files import finite

    content = {k: v for k, v in asdict(told).items() if k != "record"}
    if told.record is not None:
        content |= {"impact": str(told.record.impact), "good_hits": told.record.good}
        content |= {"faults": list(told.record.faults), "remarks": list(told.record.remarks)}
        content["coherence"] = dict(told.record.coherence)
    typer.echo(dumps(finite(content)))
