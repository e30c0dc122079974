"""The tables and figures of the source papers, recomputed beside the printed values."""

from ema_pipeline.reproduce.run import NAMES, reproduce, write_page
from ema_pipeline.reproduce.text import markdown, terminal_text
from ema_pipeline.reproduce.types import Entry, Reproduction, Table

__all__ = [
    "NAMES",
    "Entry",
    "Reproduction",
    "Table",
    "markdown",
    "reproduce",
    "terminal_text",
    "write_page",
]
