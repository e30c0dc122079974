"""What the pages and screens show of numbers (`ema_pipeline.number_text`) and of names."""

from __future__ import annotations

from ema_pipeline.number_text import below, format_percent, format_value, plain, prefixed, signed
from ema_pipeline.plain_text import part_words

__all__ = ["below", "format_percent", "format_value", "plain", "prefixed", "signed", "slug", "words"]


def words(name: str) -> str:
    """Names for reading: ``sun_planet_mesh_stiffness`` → ``sun planet mesh stiffness``."""
    return part_words(name).replace("_", " ")


def slug(text: str) -> str:
    """`text` as part of a file name or HTML id."""
    kept = "".join(c if c.isascii() and c.isalnum() else "_" for c in text.strip())
    return "_".join(part for part in kept.split("_") if part) or "x"
