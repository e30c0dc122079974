"""The one exception that users see: a single clear line, never a traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from ema_pipeline.plain_text import printable

_LONGEST = 2000
"""Characters of a message; names in a damaged file can be longer than any screen."""


class EmaError(Exception):
    """The data or the settings are wrong.

    The message is one line that says what is wrong, where (file, channel, value) and what to do
    about it. The command line prints it on stderr and exits with code 1.
    """

    def __init__(self, message: str) -> None:
        line = printable(" ".join(str(message).split()))
        if len(line) > _LONGEST:
            line = f"{line[: _LONGEST * 2 // 3]} … {line[-_LONGEST // 3 :]}"
        super().__init__(line)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a hint such as ``" (did you mean 'damping'?)"``, or the list of known words.

    >>> did_you_mean("dampign", ["damping", "mass"])
    " (did you mean 'damping'?)"
    """
    names = sorted(str(k) for k in known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    if close:
        return f" (did you mean '{close[0]}'?)"
    return f" (known: {', '.join(names)})" if names else ""
