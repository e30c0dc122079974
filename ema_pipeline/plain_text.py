"""Text of unknown origin, made fit for a terminal: no character can steer it, hide text or turn it round."""

from __future__ import annotations

import re
import unicodedata

_SUSPECT = re.compile(r"[^\t\n\x20-\x7e\u00a1-\u02ff\u0370-\u04ff\u2010-\u2027\u2030-\u2052\u2190-\u25ff]")
"""All but the characters of everyday text; only these few are looked up one by one."""

_STEERING = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Unicode categories of characters that show nothing: control, format (writing direction), surrogates, …"""


def printable(text: str) -> str:
    r"""The text with every character that shows nothing written as an escape, e.g. ``\x1b``.

    Line breaks and tabs stay.

    >>> printable("red \x1b[31m")
    'red \\x1b[31m'
    """
    return _SUSPECT.sub(_escaped, text)


_KIND = re.compile(r"(?P<name>.*\b(?P<kind>mass|spring|damper)\b.*) \((?P=kind)\)")


def part_words(name: str) -> str:
    """A part's name for reading, with its kind only where the name does not say it.

    >>> part_words("b3 mass (mass)"), part_words("link (spring)")
    ('b3 mass', 'link (spring)')
    """
    found = _KIND.fullmatch(name)
    return found["name"] if found else name


def has_control_characters(text: str) -> bool:
    """True for text with characters that show nothing, among them line breaks and tabs."""
    return printable(text) != text or any(c in text for c in "\t\n")


def _escaped(match: re.Match[str]) -> str:
    character = match[0]
    if unicodedata.category(character) not in _STEERING:
        return character
    return character.encode("unicode_escape", errors="surrogatepass").decode("ascii")
