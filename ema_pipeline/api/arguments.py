"""What callers hand in: checked at the door, so that a slip is one line that says what is wanted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ema_pipeline.errors import EmaError


def expect(name: str, given: object, kinds: type | tuple[type, ...], wanted: str) -> None:
    """EmaError unless an argument is of one of the kinds; `wanted` says what to give.

    >>> expect("frfs", None, int, "what test.frfs() gives")
    Traceback (most recent call last):
    ema_pipeline.errors.EmaError: frfs: give what test.frfs() gives, not None
    """
    if not isinstance(given, kinds):
        raise EmaError(f"{name}: give {wanted}, not {_shown(given)}")


def path(name: str, given: object) -> Path:
    """A path from text or a Path."""
    expect(name, given, (str, Path), "a path")
    return Path(given)  # type: ignore[arg-type]


def texts(name: str, given: Iterable[Any], wanted: str, kinds: tuple[type, ...] = (str,)) -> tuple[Any, ...]:
    """A list of texts as a tuple; a lone text, which is a list of letters to Python, is refused.

    >>> texts("hits", "free/a.csv", "a list of texts such as 'free/a.csv#1'")
    Traceback (most recent call last):
    ema_pipeline.errors.EmaError: hits: give a list of texts such as 'free/a.csv#1', not 'free/a.csv'
    """
    if isinstance(given, (str, Path)) or not isinstance(given, Iterable):
        raise EmaError(f"{name}: give {wanted}, not {_shown(given)}")
    found = tuple(given)
    for one in found:
        expect(name, one, kinds, wanted)
    return found


def effects(given: Iterable[Any]) -> tuple[str, ...]:
    """Effects as they are named."""
    return texts("effects", given, "texts such as 'spring@base'")


def effect_files(given: Iterable[Any]) -> tuple[str, ...]:
    """Python files with effects."""
    return tuple(map(str, texts("effect_files", given, "a list of paths", (str, Path))))


def plain(value: Any) -> Any:
    """Numbers and arrays of NumPy, tuples and what holds them as TOML's reader gives such values."""
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def _shown(given: object) -> str:
    if given is None or isinstance(given, str | int | float | list | tuple):
        text = repr(given)
        return text if len(text) <= 60 else f"{text[:57]}..."
    return type(given).__name__
