"""Raw folders: drafted, checked, simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ema_pipeline.commands.options import EffectFiles, Json, Overrides, Quiet, Raw
from ema_pipeline.commands.screen import program, show, show_json

if TYPE_CHECKING:
    from ema_pipeline.simulate.campaign import SimulatedCampaign


def check(raw: Raw, set_: Overrides = None, json: Json = False) -> None:
    """Judge every hit of a raw folder: value, limit and clause of each check. Other records: what they contain.

    The exit code is 1 where a point has no good hit left.
    """
    from ema_pipeline.ingest.chosen import require_good_hits
    from ema_pipeline.raw_folder import check_raw, check_records
    from ema_pipeline.report import summary_files, terminal

    records = check_records(raw, set_ or [])
    if records is not None and json:
        show_json({"records": records})
        return
    if records is not None:
        for line in records:
            show(line)
        return
    judged = check_raw(raw, set_ or [])
    if json:
        show_json(summary_files.finite({name: [asdict(h) for h in hits] for name, hits in judged.items()}))
    else:
        for name, hits in judged.items():
            show(terminal.verdict_table(hits, name))
            show(terminal.hits_table(hits, name))
    for name, hits in judged.items():
        require_good_hits(hits, name)


def init(raw: Raw, set_: Overrides = None) -> None:
    """Draft test.toml from what the record files say."""
    from ema_pipeline.raw_folder import draft_raw

    for path in draft_raw(raw, set_ or []):
        show(f"Wrote {path}; look for the lines marked CHECK, then: {program()} check {raw}")


def simulate(
    out: Annotated[Path, typer.Argument(metavar="RAW", help="Folder to write.")],
    rig: Annotated[str, typer.Option("--rig", "-r", metavar="RIG", help="Rig, or a rig file.")] = "planetary",
    configuration: Annotated[
        list[str] | None,
        typer.Option(
            "--configuration", "-c", metavar="NAME", help="Configuration; all if left out. May be repeated."
        ),
    ] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            "-e",
            metavar="ID@PLACE:NAME=VALUE",
            help="Hidden effect and its size; left out, one that shows clearly. May be repeated.",
        ),
    ] = None,
    effect_file: EffectFiles = None,
    value: Annotated[
        list[str] | None,
        typer.Option("--value", metavar="NAME=VALUE", help="True value of a parameter. May be repeated."),
    ] = None,
    sensor: Annotated[
        list[str] | None, typer.Option("--sensor", metavar="DOF", help="DOF of a sensor. May be repeated.")
    ] = None,
    impact: Annotated[
        list[str] | None, typer.Option("--impact", metavar="DOF", help="DOF that is struck. May be repeated.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Setting of the test, e.g. sample_rate_hz=25600; all: ema settings simulate. May be repeated.",
        ),
    ] = None,
    format_: Annotated[
        str | None, typer.Option("--format", help="uff, csv, hdf5, mat, wav or tdms; uff if left out.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers; 0 if left out.")] = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a hammer test of a rig and write it as a raw folder."""
    from ema_pipeline.raw_folder import simulate_raw

    options = {"format": format_, "seed": seed}
    own = [f"{name}={value}" for name, value in options.items() if value is not None]
    made = simulate_raw(
        out,
        rig,
        configurations=configuration or [],
        effects=effect or [],
        effect_files=effect_file or [],
        values=value or [],
        sensors=sensor or [],
        impacts=impact or [],
        settings=[*(set_ or []), *own],
    )
    if not quiet:
        where = ", ".join(made.configurations)
        show(f"Wrote {made.records} records ({where}) to {out}; the truth is in {out / 'truth.json'}")
        for line in _assumed_sizes(made):
            show(line)


def _assumed_sizes(made: SimulatedCampaign) -> Iterator[str]:
    """A line on every effect whose size, or part of it, was left out."""
    from ema_pipeline.effects.base import effect_of

    for label in dict.fromkeys(map(effect_of, made.assumed)):
        own = {name: name.removeprefix(f"{label}.") for name in made.values if effect_of(name) == label}
        sizes = [
            f"{own[name]} = {made.values[name]:.4g} {'' if unit == '1' else unit}".rstrip()
            for name, unit in made.assumed.items()
            if name in own
        ]
        yield (
            f"{label} has {' and '.join(sizes)} by default; "
            f"to choose: --effect {label}:{','.join(f'{name}=VALUE' for name in own.values())}"
        )
