"""What ships with the program: rigs, effects, a model's modes, the source papers' tables."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Json, RigOption
from ema_pipeline.commands.screen import program, show, show_json

_SIMULATE = "simulate"
"""Names the settings of ``ema simulate``, which are no pipeline's."""


def rigs(json: Json = False) -> None:
    """List the rigs that ship with the program."""
    from ema_pipeline.rigs import rig_kinds

    if json:
        show_json({"rigs": [{"name": name, "title": kind.title} for name, kind in rig_kinds().items()]})
        return
    for name, kind in rig_kinds().items():
        show(f"{name:12s} {kind.title}")


def effects(rig: RigOption = None, effect_file: EffectFiles = None, json: Json = False) -> None:
    """List the physical effects that a model may be missing, with places, parameters and signs."""
    from ema_pipeline.catalogue import list_effects
    from ema_pipeline.report.listings import effects_list

    listed = list_effects(rig or "planetary", effect_file or [])
    if json:
        show_json({"effects": listed})
    else:
        show(effects_list(listed))


def settings(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Only settings whose name starts so, e.g. 'frf'; 'simulate': those of 'ema simulate'.",
        ),
    ] = "",
    json: Json = False,
) -> None:
    """List every setting of a pipeline, or of a simulated test: name, default, what it may be, and why."""
    from ema_pipeline.catalogue import list_settings, list_simulation_settings
    from ema_pipeline.errors import EmaError, did_you_mean

    listed = list_simulation_settings() if name == _SIMULATE else list_settings(name)
    if not listed:
        known = {_SIMULATE, *(s["name"].partition(".")[0] for s in list_settings())}
        raise EmaError(f"no setting starts with '{name}'{did_you_mean(name, known)}")
    if json:
        show_json({"settings": listed})
        return
    from ema_pipeline.report.listings import settings_list

    show(settings_list(listed))
    if not name:
        show(f"Settings of simulated tests: {program()} settings {_SIMULATE}")


def model(
    rig: Annotated[str, typer.Option("--rig", "-r", metavar="RIG", help="Name of a rig, or a rig file.")],
    configuration: Annotated[
        str | None, typer.Option("--configuration", "-c", help="Configuration; all if left out.")
    ] = None,
    parameters: Annotated[
        bool, typer.Option("--parameters", help="Show the rig's parameters with their tolerances instead.")
    ] = False,
    json: Json = False,
) -> None:
    """Show the modes of the model itself, or its parameters."""
    from ema_pipeline.catalogue import list_model_modes, list_parameters
    from ema_pipeline.report.listings import model_table, parameters_table

    if parameters:
        stated = list_parameters(rig)
        if json:
            show_json({"parameters": stated})
        else:
            show(parameters_table(stated))
        return
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
    json: Json = False,
) -> None:
    """Compute the tables and figures of the source papers anew, beside what they print."""
    from ema_pipeline.reproduce import NAMES, terminal_text
    from ema_pipeline.reproduce import reproduce as compute

    found = [compute(name, out) for name in ((which,) if which else NAMES)]
    if json:
        show_json({r.name: [asdict(table) for table in r.tables] for r in found})
        return
    for reproduced in found:
        show(terminal_text(reproduced))
