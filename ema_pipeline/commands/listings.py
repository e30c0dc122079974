"""What ships with the program: rigs, effects, a model's modes, the source papers' tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ema_pipeline.commands.options import Json, RigOption
from ema_pipeline.commands.screen import show, show_json


def rigs() -> None:
    """List the rigs that ship with the program."""
    from ema_pipeline.rigs import rig_kinds

    for name, kind in rig_kinds().items():
        show(f"{name:12s} {kind.title}")


def effects(rig: RigOption = None, json: Json = False) -> None:
    """List the physical effects that a model may be missing, with places, parameters and signs."""
    from ema_pipeline.job import list_effects
    from ema_pipeline.report.listings import effects_list

    listed = list_effects(rig or "planetary")
    if json:
        show_json({"effects": listed})
    else:
        show(effects_list(listed))


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
        show_json({"modes": first, "configurations": listed} if len(listed) > 1 else {"modes": first})
    else:
        for name, modes in listed.items():
            show(model_table(name, modes))


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
        show(terminal_text(compute(name, out)))
