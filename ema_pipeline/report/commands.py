"""Commands that are shown to be copied, as a user types them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence


def command(verb: str, out: str, *words: str, effect_files: Sequence[str] = ()) -> str:
    """A command on a results folder, to be pasted as it stands.

    Parameters
    ----------
    verb : str
    out : str
        Results folder as the user would type it; empty where it is not known.
    *words : str
        What the command takes beside it.
    effect_files : sequence of str
        Files with the user's own effects: their code runs only where a command names them.
    """
    return shlex.join(["ema", verb, out or "OUT", *words, *naming(effect_files)])


def naming(effect_files: Sequence[str]) -> list[str]:
    """The words that name files with the user's own effects."""
    return [word for file in effect_files for word in ("--effect-file", file)]


def typed(shown: str, program: str) -> str:
    """A command with ``ema`` as the user can type it."""
    return shown.replace("ema ", f"{shlex.quote(program)} ", 1)
