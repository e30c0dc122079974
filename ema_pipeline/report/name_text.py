"""Names of parts, quantities and configurations: for reading, and as parts of file names and HTML ids."""

from __future__ import annotations

from ema_pipeline.plain_text import part_words


def words(name: str) -> str:
    """Names for reading: ``sun_planet_mesh_stiffness`` → ``sun planet mesh stiffness``."""
    return part_words(name).replace("_", " ")


def slug(text: str) -> str:
    """`text` as part of a file name or HTML id."""
    kept = "".join(c if c.isascii() and c.isalnum() else "_" for c in text.strip())
    return "_".join(part for part in kept.split("_") if part) or "x"
