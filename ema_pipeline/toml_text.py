"""TOML from anywhere: read within limits, and every fault is one line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from ema_pipeline.errors import EmaError
from ema_pipeline.files import read_bounded

LARGEST_BYTES = 4_000_000
"""A campaign of ten thousand records has 1 MB; the reader takes a second per MB."""

_MOST_KEY_PARTS = 100
"""Ours have four at most; the reader's time grows with the square of their number."""


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file holds.

    Raises
    ------
    EmaError
        If it cannot be read, is too large or is no TOML; names the file.
    """
    return parse_toml(read_toml_text(path), path)


def read_toml_text(path: Path) -> str:
    """Text of a TOML file.

    Raises
    ------
    EmaError
        If it cannot be read, is too large or is not UTF-8; names the file.
    """
    data = read_bounded(path, LARGEST_BYTES)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise EmaError(f"{path}: line {line} is not UTF-8 text; save the file as UTF-8") from None


def parse_toml(text: str, where: str | Path) -> dict[str, Any]:
    """What a TOML text holds; `where` is named in error messages.

    Raises
    ------
    EmaError
        If it is no TOML, or nested deeper than any description.
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if line.count(".") > _MOST_KEY_PARTS and _longest_key(line) > _MOST_KEY_PARTS:
            raise EmaError(
                f"{where}: line {number} has a key of more than {_MOST_KEY_PARTS} parts; shorten it"
            )
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise EmaError(
            f"{where}: not valid TOML: its brackets are nested too deep; is it the right file?"
        ) from None
    except ValueError as error:  # tomllib's own error, and what Python says of numbers with too many digits
        raise EmaError(f"{where}: not valid TOML: {error}") from None


def _longest_key(line: str) -> int:
    """Most dots between two signs that end a key."""
    return max(part.count(".") for part in re.split(r"[=,{}\[\]]", line))
