"""Degrees of freedom as technicians write them: ``sun.x``, ``-planet1.zeta``, ``point07.z``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ema_pipeline.errors import EmaError

_PATTERN = re.compile(r"^\s*([+-]?)\s*(\w[\w-]*)\.([^\W\d]\w*)\s*$")


@dataclass(frozen=True, order=True)
class Dof:
    """A measured degree of freedom: where, and which way.

    Attributes
    ----------
    body : str
        Body or point, e.g. ``"sun"``.
    direction : str
        Direction on the body, e.g. ``"x"``, ``"u"``, ``"zeta"``.
    sign : int
        +1, or -1 where the sensor or the blow points the other way.
    """

    body: str
    direction: str
    sign: int = 1

    @classmethod
    def parse(cls, text: str) -> Dof:
        """Read ``"body.direction"`` with an optional leading ``-``.

        Raises
        ------
        EmaError
            If the text is not of that form.
        """
        match = _PATTERN.match(text)
        if match is None:
            raise EmaError(
                f"dof '{text}' is not of the form body.direction, e.g. 'sun.x' or '-sun.x'; the name of a body has "
                "letters, digits, '_' and '-', but no spaces"
            )
        return cls(match[2], match[3], -1 if match[1] == "-" else 1)

    @property
    def point(self) -> str:
        """The DOF without its sign, ``"sun.x"``."""
        return f"{self.body}.{self.direction}"

    def __str__(self) -> str:
        return ("-" if self.sign < 0 else "") + self.point
