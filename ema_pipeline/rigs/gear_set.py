"""Drawing of a planetary gear set: carrier, ring, sun and planets in their plane."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from ema_pipeline.rigs.drawing import Body, Drawing, Motion, Move

_PLANET = re.compile(r"planet(\d+)$")
_CARRIER, _RING, _SUN, _PLANETS = "#f2d8c0", "#dcdcdc", "#f6ecb0", "#cfe3f1"
_TEETH = 16
"""Of the sun, whose radius is the unit of the drawing."""


def in_plane(points: Sequence[str], complete: bool) -> Drawing | None:
    """A set whose bodies move in the plane; None where the points are not those of one."""
    return None if complete and _only_turn(points) else _gear_set(points, _moving)


def torsional(points: Sequence[str], complete: bool) -> Drawing | None:
    """A set whose bodies only turn, inside a ring that is fixed; None where the points are not those of one."""
    if not complete or not _only_turn(points):
        return None
    return _gear_set((*points, "ring.u"), _turning, directions=1)


def _only_turn(points: Sequence[str]) -> bool:
    return all(p.endswith(".u") for p in points)


def _gear_set(points: Sequence[str], move: Move, directions: int = 3) -> Drawing | None:
    """The bodies that the DOFs name; None where they are not those of a planetary gear."""
    bodies = {p.split(".")[0] for p in points}
    numbers = sorted(int(m[1]) for b in bodies if (m := _PLANET.match(b)))
    if not numbers or "sun" not in bodies or "carrier" not in bodies:
        return None
    count = max(max(numbers), 2)
    # neighbours must not touch: 2 (1 + r) sin(π/N) > 2.3 r
    sine = np.sin(np.pi / count)
    planet = float(min(0.9, 2 * sine / (2.3 - 2 * sine) if sine < 1.1 else 0.9))
    centre, rim = 1.0 + planet, 1 + 2 * planet
    angles = [2 * np.pi * n / max(numbers) for n in range(max(numbers))]
    centres = [(centre * float(np.cos(psi)), centre * float(np.sin(psi))) for psi in angles]
    drawn = [Body("carrier", 0, 0, centre, "arms", _CARRIER, arms=tuple(centres))]
    if "ring" in bodies:
        drawn.append(Body("ring", 0, 0, rim, "ring", _RING, round(_TEETH * rim)))
    drawn.append(Body("sun", 0, 0, 1.0, "disc", _SUN, _TEETH))
    teeth = max(round(_TEETH * planet), 6)
    for n, (psi, (x, y)) in enumerate(zip(angles, centres, strict=True), start=1):
        drawn.append(Body(f"planet{n}", x, y, planet, "disc", _PLANETS, teeth, psi))
    return Drawing(tuple(drawn), rim + (0.75 if "ring" in bodies else 0.45), move, directions)


def _moving(bodies: Sequence[Body], known: Mapping[str, complex]) -> dict[str, Motion]:
    """Motions in the plane. A planet's x and y come from themselves, or else from its zeta and eta."""
    result = {}
    for body in bodies:
        b = body.name
        x, y = known.get(f"{b}.x"), known.get(f"{b}.y")
        if (x is None or y is None) and _PLANET.match(b):
            zeta, eta = known.get(f"{b}.zeta"), known.get(f"{b}.eta")
            c, s = np.cos(body.psi), np.sin(body.psi)
            if zeta is not None and eta is not None:
                x, y = c * zeta - s * eta, s * zeta + c * eta
            elif (zeta is not None or eta is not None) and x is None and y is None:
                # one direction only: the body is drawn moving along it
                x, y = (c * zeta, s * zeta) if zeta is not None else (-s * (eta or 0), c * (eta or 0))
                other = "eta" if zeta is not None else "zeta"
                u = known.get(f"{b}.u")
                result[b] = Motion(x, y, u or 0, (other,) if u is not None else (other, "u"))
                continue
        u = known.get(f"{b}.u")
        missing = tuple(d for d, v in (("x", x), ("y", y), ("u", u)) if v is None)
        result[b] = Motion(x or 0, y or 0, u or 0, missing)
    return result


def _turning(bodies: Sequence[Body], known: Mapping[str, complex]) -> dict[str, Motion]:
    """Motions about held centres; the carrier takes those of the planets along, and the ring does not move."""
    carried, result = known.get("carrier.u", 0.0), {}
    for body in bodies:
        u = known.get(f"{body.name}.u")
        x: complex = 0.0
        y: complex = 0.0
        if _PLANET.match(body.name):
            x, y = -np.sin(body.psi) * carried, np.cos(body.psi) * carried
        missing = ("u",) if u is None and body.name != "ring" else ()
        result[body.name] = Motion(x, y, u or 0, missing)
    return result
