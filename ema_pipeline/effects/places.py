"""Places that several effects share, found by the names of DOFs and elements."""

from __future__ import annotations

import re

from ema_pipeline.mechanics.assembly import Assembly, Row

ALL = "all"
"""Place of an effect that sits on all bodies at once."""


MESH = " mesh"
"""End of the name of a mesh's spring; what stands before it is the place."""


def is_planet(body: str) -> bool:
    """True for ``planet1``, ``planet2`` …"""
    return re.fullmatch(r"planet\d+", body) is not None


def planets(assembly: Assembly) -> tuple[str, ...]:
    """The planets."""
    return tuple(b for b in assembly.bodies if is_planet(b))


def bodies_with_bearings(assembly: Assembly) -> tuple[str, ...]:
    """Bodies on a bearing to ground: springs ``body bearing x`` and ``body bearing y``."""
    names = {e.name for e in assembly.elements}
    return tuple(b for b in assembly.bodies if {f"{b} bearing x", f"{b} bearing y"} <= names)


def meshes(assembly: Assembly) -> tuple[str, ...]:
    """Gear meshes, by the pair of gears in mesh."""
    return tuple(e.name.removesuffix(MESH) for e in assembly.springs(suffix=MESH))


def bodies_in_plane(assembly: Assembly) -> tuple[str, ...]:
    """Bodies that move in x and y."""
    return tuple(b for b in assembly.bodies if assembly.has_dof(f"{b}.x") and assembly.has_dof(f"{b}.y"))


def plane_rows(assembly: Assembly, body: str) -> tuple[Row, Row]:
    """Rows of a body's x and y, also where these are no coordinates (planets)."""
    return assembly.row(f"{body}.x"), assembly.row(f"{body}.y")


def bodies_that_only_turn(assembly: Assembly) -> tuple[str, ...]:
    """Bodies whose only coordinate is u = r·θ."""
    return tuple(b for b in assembly.bodies if assembly.coordinates(b) == (f"{b}.u",))
