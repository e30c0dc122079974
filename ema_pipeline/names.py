"""Names from files that become names of files, folders and groups of the results."""

from __future__ import annotations

import re

from ema_pipeline.errors import EmaError
from ema_pipeline.plain_text import has_control_characters

_LONGEST = 100
_FORBIDDEN = re.compile(r'[/\\<>:"|?*]')
"""Characters that lead into other folders, or that Windows does not allow in names."""

_RESERVED = {"all", ".", ".."}
"""``all`` stands for all configurations together in the results file."""


def check_name(name: str, what: str) -> str:
    """The name, if a file can be called so on any system.

    Parameters
    ----------
    name : str
    what : str
        What is named, for the message, e.g. ``"configuration"``.

    Raises
    ------
    EmaError
        Says what is wrong with the name.
    """
    if not name.strip() or name != name.strip():
        raise EmaError(f"{what} '{name}' is empty or has blanks at its ends; rename it")
    if len(name.encode("utf-8", errors="replace")) > _LONGEST:
        raise EmaError(f"{what} '{name[:30]}…' is longer than {_LONGEST} characters; shorten it")
    if _FORBIDDEN.search(name) or has_control_characters(name):
        raise EmaError(
            f"{what} '{name}' has a character that cannot stand in a file name; use letters, digits, - and _"
        )
    if name.casefold() in _RESERVED or name.startswith("."):
        raise EmaError(f"{what} '{name}' cannot name a file; choose another name")
    return name
