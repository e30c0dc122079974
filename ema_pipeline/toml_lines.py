"""The line of each key in a TOML text, for error messages: the standard reader does not report it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress

Location = tuple[str | int, ...]

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_BASIC = re.compile(r'"((?:[^"\\\n]|\\.)*)"')
_LITERAL = re.compile(r"'([^'\n]*)'")
_LONG = re.compile(r'"""(?:[^\\]|\\.)*?"""+|' + r"'''.*?'''+", re.DOTALL)
_PLAIN = re.compile(r"[^,\]}#\n]+")
_SPACE = re.compile(r"[ \t]+")
_SPACE_AND_LINES = re.compile(r"(?:\s|#[^\n]*)+")


def key_lines(text: str) -> dict[Location, int]:
    """Line, from 1, of every key, table and item of an array.

    Parameters
    ----------
    text : str
        Valid TOML; of other text the lines up to the first fault may come out.

    Returns
    -------
    dict
        By path: ``("parameters", "sun_mass", "value")``, ``("springs", 0, "between")``.
    """
    scanner = _Scanner(text)
    with suppress(IndexError, StopIteration):  # where it is no TOML
        scanner.document()
    return scanner.lines


def line_of(lines: Mapping[Location, int], location: Sequence[str | int]) -> int | None:
    """Line of a location, or of what holds it where it has none itself."""
    path = tuple(location)
    while path:
        if path in lines:
            return lines[path]
        path = path[:-1]
    return None


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text.replace("\r\n", "\n")
        self.at = 0
        self.lines: dict[Location, int] = {}
        self.counts: dict[Location, int] = {}

    def document(self) -> None:
        table: Location = ()
        self.skip(_SPACE_AND_LINES)
        while self.at < len(self.text):
            if self.text.startswith("[[", self.at):
                self.at += 2
                table = self.resolved(self.key())
                index = self.counts[table] = self.counts.get(table, -1) + 1
                self.note(table)
                table = (*table, index)
                self.note(table)
                self.at += 2
            elif self.text[self.at] == "[":
                self.at += 1
                table = self.resolved(self.key())
                self.note(table)
                self.at += 1
            else:
                self.pair(table)
            self.skip(_SPACE_AND_LINES)

    def pair(self, table: Location) -> None:
        start = self.at
        path = table + self.key()
        for end in range(len(table) + 1, len(path) + 1):
            self.note(path[:end], start)
        self.skip(_SPACE)
        self.at += 1  # the equals sign
        self.value(path)

    def value(self, path: Location) -> None:
        self.skip(_SPACE)
        opening = self.text[self.at]
        if opening in "[{":
            self.at += 1
            closing, index = "]" if opening == "[" else "}", 0
            self.skip(_SPACE_AND_LINES)
            while self.text[self.at] != closing:
                if opening == "{":
                    self.pair(path)
                else:
                    self.note((*path, index))
                    self.value((*path, index))
                    index += 1
                self.skip(_SPACE_AND_LINES)
                if self.text[self.at] == ",":
                    self.at += 1
                self.skip(_SPACE_AND_LINES)
            self.at += 1
            return
        for pattern in (_LONG, _BASIC, _LITERAL, _PLAIN):
            if match := pattern.match(self.text, self.at):
                self.at = match.end()
                return
        raise IndexError

    def key(self) -> tuple[str, ...]:
        parts: list[str] = []
        while True:
            self.skip(_SPACE)
            match = next(m for p in (_BASIC, _LITERAL, _BARE) if (m := p.match(self.text, self.at)))
            parts.append(match[1] if match.re.groups else match[0])
            self.at = match.end()
            self.skip(_SPACE)
            if self.text[self.at] != ".":
                return tuple(parts)
            self.at += 1

    def resolved(self, key: tuple[str, ...]) -> Location:
        """A table's path: a part that is an array of tables stands for its last item, save the last part."""
        path: Location = ()
        for part in key[:-1]:
            path = (*path, part)
            if path in self.counts:
                path = (*path, self.counts[path])
        return (*path, key[-1])

    def note(self, path: Location, at: int | None = None) -> None:
        self.lines.setdefault(path, self.text.count("\n", 0, self.at if at is None else at) + 1)

    def skip(self, pattern: re.Pattern[str]) -> None:
        if match := pattern.match(self.text, self.at):
            self.at = match.end()
