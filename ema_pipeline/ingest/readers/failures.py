"""What a library's exception says to someone who has a damaged file, if anything."""

from __future__ import annotations

import csv
import struct
import zlib

_LONGEST = 120

_OF_THE_PROGRAM = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    NameError,
    RecursionError,
    TypeError,
    UnicodeError,
    csv.Error,
    struct.error,
    zlib.error,
)
"""Exceptions whose texts speak of variables, indices and buffers."""


def words_of(error: Exception) -> str:
    """The first line of its text; empty where that speaks of the program and not of the file."""
    lines = str(error).strip().splitlines()
    if not lines or isinstance(error, _OF_THE_PROGRAM) or any(w in lines[0] for w in ("b'", "reshape")):
        return ""
    return lines[0][:_LONGEST]
