"""Pages of the documentation site that are made when it is built: the README, all commands, all settings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer.main
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from ema_pipeline.catalogue import list_settings
from ema_pipeline.cli import app
from ema_pipeline.report.listings import setting_text

ROOT = Path(__file__).resolve().parent.parent


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to those of docs/."""
    for name, make in (
        ("index.md", start_page),
        ("commands.md", commands_page),
        ("settings.md", settings_page),
    ):
        files.append(File.generated(config, name, content=make()))
    return files


def start_page() -> str:
    """The README; links into docs/ lead to the site's pages, links to other files of the repository become text."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|docs/|#)[^)]*\)", r"\1", text)
    return text.replace("](docs/", "](")


def commands_page() -> str:
    """Every command with its arguments and options, from its own help."""
    parts = ["# Commands\n"]
    group: Any = typer.main.get_command(app)
    for name, command in _commands(group):
        context = command.make_context(f"ema {name}", [], resilient_parsing=True)
        usage = " ".join(command.collect_usage_pieces(context))
        parts.append(f"## ema {name}\n\n{command.help}\n\n```sh\nema {name} {usage}\n```\n")
        rows = [_row(p) for p in command.params if p.name != "help"]
        if rows:
            parts.append("| | |\n|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def _commands(group: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """All commands with their full names, those of groups within the group as well."""
    found: list[tuple[str, Any]] = []
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            found += _commands(command, f"{prefix}{name} ")
        else:
            found.append((f"{prefix}{name}", command))
    return found


def _row(parameter: Any) -> str:
    names = ", ".join(f"`{o}`" for o in (*parameter.opts, *parameter.secondary_opts))
    told = getattr(parameter, "help", None) or ""
    if parameter.param_type_name == "argument":
        names = f"`{parameter.metavar or parameter.name}`"
    return f"| {names} | {_cell(told)} |"


def settings_page() -> str:
    """Every setting: default, what it may be, and why."""
    parts = [
        "# Settings\n\nChange one with `--set NAME=VALUE`, in a pipeline's TOML file, or with `settings=` in Python."
    ]
    before = None
    for setting in list_settings():
        stage, _, name = setting["name"].rpartition(".")
        if stage != before:
            parts.append(
                f"\n## {stage or 'pipeline'}\n\n| setting | default | values | why |\n|---|---|---|---|"
            )
            before = stage
        cells = (name, setting_text(setting["default"]), setting["values"], setting["description"])
        parts.append(f"| `{cells[0]}` | `{cells[1]}` | {_cell(cells[2])} | {_cell(cells[3])} |")
    return "\n".join(parts)


def _cell(text: Any) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")
