"""Places of the generic effects: one DOF (to ground), or two (``carrier.x-sun.x``, between them)."""

from __future__ import annotations

from ema_pipeline.mechanics.assembly import Assembly, Row, difference


def coordinates(assembly: Assembly) -> tuple[str, ...]:
    """Single DOFs that are listed as places."""
    return (*assembly.dofs, *assembly.sensors)


def is_pair(assembly: Assembly, place: str) -> bool:
    """True for two DOFs of the assembly joined by ``-``."""
    return _split(assembly, place) is not None


def place_row(assembly: Assembly, place: str) -> Row:
    """Row of the motion at a DOF, or of the motion between two."""
    pair = _split(assembly, place)
    if pair is None:
        return assembly.row(place)
    return difference(assembly.row(pair[0]), assembly.row(pair[1]))


def _split(assembly: Assembly, place: str) -> tuple[str, str] | None:
    # Names of bodies may hold "-" themselves, so every one is tried.
    for i, character in enumerate(place):
        a, b = place[:i], place[i + 1 :]
        if character == "-" and a != b and assembly.has_dof(a) and assembly.has_dof(b):
            return a, b
    return None
