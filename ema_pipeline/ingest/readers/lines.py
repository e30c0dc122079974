"""The lines of a text file, cut where they are asked for: a list of them takes ten times the memory of the file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError

_LINE_FEED, _BLANK = 10, 32

_LONGEST = 2_000_000
"""Characters of a line: 5000 channels have some hundred thousand."""


class Lines:
    """Lines of a text that hold more than blanks.

    Parameters
    ----------
    text : bytes
        UTF-8; lines end with line feed, carriage return, or both.

    Attributes
    ----------
    text : bytes
        The same with line feeds only.

    Raises
    ------
    EmaError
        For a line that is longer than the row of any table.
    """

    def __init__(self, text: bytes) -> None:
        if b"\r" in text:
            text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        self.text = text if text.endswith(b"\n") else text + b"\n"
        characters = np.frombuffer(self.text, dtype=np.uint8)
        # Half the memory, and no file of text is read that needs more.
        small: Any = np.int32 if characters.size < 2**31 else np.int64
        self._starts = np.append(0, np.flatnonzero(characters == _LINE_FEED) + 1).astype(small)
        longest = int(np.diff(self._starts).max())
        if longest > _LONGEST:
            raise EmaError(
                f"has a line of {longest / 1e6:.3g} MB, which is no row of a table; export it again"
            )
        filled = np.logical_or.reduceat(characters > _BLANK, self._starts[:-1])
        self._numbers = np.flatnonzero(filled).astype(small)

    def __len__(self) -> int:
        return int(self._numbers.size)

    def __getitem__(self, index: int) -> str:
        number = self._numbers[index]
        return self.text[self._starts[number] : self._starts[number + 1] - 1].decode("utf-8", "replace")

    def number(self, index: int) -> int:
        """Number of a line within the file, from 1."""
        return int(self._numbers[index]) + 1

    def some(self, start: int, stop: int) -> Iterator[str]:
        """Lines ``start:stop``."""
        return (self[i] for i in range(max(start, 0), min(stop, len(self))))

    def block(self, start: int, stop: int) -> bytes:
        """Lines ``start:stop`` as they stand in the file."""
        return self.text[self._starts[self._numbers[start]] : self._starts[self._numbers[stop - 1] + 1]]

    def counts(self, character: str, start: int, stop: int) -> NDArray[np.int64]:
        """How often an ASCII character stands in each of the lines ``start:stop``."""
        first, last = self._numbers[start], self._numbers[stop - 1] + 1
        cut = np.frombuffer(self.text, dtype=np.uint8)[self._starts[first] : self._starts[last]]
        per_line = np.add.reduceat(
            cut == ord(character), self._starts[first:last] - self._starts[first], dtype=np.int64
        )
        found: NDArray[np.int64] = per_line[self._numbers[start:stop] - first]
        return found
