"""Options that several subcommands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Raw = Annotated[Path, typer.Argument(metavar="RAW", help="Raw folder: test.toml and the record files.")]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="Results folder of an earlier run.")]
RigOption = Annotated[
    str | None, typer.Option("--rig", "-r", metavar="RIG", help="Name of a rig, or a rig file (.toml).")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say which stages were computed, and where a bug happened.")
]
EffectFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--effect-file",
        metavar="FILE.py",
        help="A file with an effect of your own; its code runs in this call. May be repeated.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one setting of the pipeline. May be repeated."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
