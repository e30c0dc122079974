"""The rig at rest with the places of effects marked: where to look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ema_pipeline.report.moving_shapes import UNITS, in_units, outline_path
from ema_pipeline.rigs.drawing import Body, Drawing

_LARGEST_GAP = 0.35
"""Bodies whose outlines are nearer than this mesh with each other; in units of the drawing."""


@dataclass(frozen=True)
class DrawnBody:
    """A body in drawing units: its outline about (x, y), and whether it is named."""

    name: str
    path: str
    x: float
    y: float
    form: str
    fill: str
    named: bool


@dataclass(frozen=True)
class EffectPlaces:
    """Bodies from back to front, and the points where two named bodies meet."""

    view_box: str
    bodies: tuple[DrawnBody, ...]
    marks: tuple[tuple[float, float], ...]
    words: str


def effect_places(drawing: Drawing | None, places: Sequence[str]) -> EffectPlaces | None:
    """Where effects sit on the rig; None where the rig has no drawing or no body is named.

    Parameters
    ----------
    drawing : Drawing or None
    places : sequence of str
        Of effects, e.g. ``"sun-planet1"``, ``"carrier"``, ``"planet2.x"``.
    """
    if drawing is None:
        return None
    by_name = {b.name: b for b in drawing.bodies}
    groups = [[p.partition(".")[0] for p in place.split("-")] for place in places]
    named = {name for group in groups for name in group if name in by_name}
    if not named:
        return None
    marks = []
    for group in groups:
        if len(group) == 2 and all(name in by_name for name in group):
            meeting = _meeting(by_name[group[0]], by_name[group[1]])
            if meeting is not None:
                marks.append((in_units(meeting[0]), in_units(-meeting[1])))
    bodies = tuple(
        DrawnBody(b.name, outline_path(b), in_units(b.x), in_units(-b.y), b.form, b.fill, b.name in named)
        for b in drawing.bodies
    )
    reach = 1.08 * drawing.reach * UNITS
    box = " ".join(f"{v:.0f}" for v in (-reach, -reach, 2 * reach, 2 * reach))
    return EffectPlaces(box, bodies, tuple(marks), f"Rig with {', '.join(places)} marked")


def _meeting(a: Body, b: Body) -> tuple[float, float] | None:
    """Where two bodies mesh, None where they do not."""
    outer, inner = (a, b) if a.radius >= b.radius else (b, a)
    distance = math.hypot(inner.x - outer.x, inner.y - outer.y)
    gaps = (abs(distance - outer.radius - inner.radius), abs(distance + inner.radius - outer.radius))
    if distance == 0 or min(gaps) > _LARGEST_GAP:
        return None
    share = outer.radius / distance
    return outer.x + share * (inner.x - outer.x), outer.y + share * (inner.y - outer.y)
