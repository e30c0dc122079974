"""Where the bodies sit, for programs that draw shapes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Geometry:
    """Positions of bodies or points and the lines drawn between them.

    Attributes
    ----------
    positions_m : dict of str to tuple of float
        Body to (x, y, z), m.
    lines : tuple of tuple of str
        Each a path along bodies.
    """

    positions_m: dict[str, tuple[float, float, float]]
    lines: tuple[tuple[str, ...], ...] = ()
