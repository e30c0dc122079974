"""How far a diagnosis has come, told to whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""``progress(share, text)``: share of the work that is done, and what is being done."""


def part(tell: Progress, low: float, high: float) -> Progress:
    """Progress of a part of the work within the whole."""
    return lambda share, text: tell(low + (high - low) * share, text)
