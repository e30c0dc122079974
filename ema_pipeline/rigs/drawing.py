"""How a rig is drawn: its bodies in their plane, and how a shape moves them.

A drawing is a scheme: radii are such that bodies meet, not those of the real ones. A displacement in x and y and a
rotation u = rθ keep their proportion: a point of the drawn circle moves by u.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Motion:
    """Complex motion of a body: x, y in the fixed frame and u = rθ; `missing` names what is not known."""

    x: complex
    y: complex
    u: complex
    missing: tuple[str, ...] = ()


@dataclass(frozen=True)
class Body:
    """One body of a drawing.

    Attributes
    ----------
    name : str
        As in DOFs. Bodies whose names differ in their number only look alike.
    x, y : float
        Its centre.
    radius : float
        Of the circle that `u` belongs to.
    form : str
        ``"disc"``, ``"ring"`` (a hole in a ring) or ``"arms"`` (a circle with arms to the points `arms`).
    fill : str
        Its colour, e.g. ``"#cfe3f1"``.
    teeth : int
        0 for a plain circle.
    psi : float
        Angle of its own frame, rad.
    arms : tuple of (float, float)
    """

    name: str
    x: float
    y: float
    radius: float
    form: Literal["disc", "ring", "arms"]
    fill: str
    teeth: int = 0
    psi: float = 0.0
    arms: tuple[tuple[float, float], ...] = ()

    @property
    def like(self) -> str:
        """What it and the bodies that look like it are called."""
        return self.name.rstrip("0123456789")

    @property
    def label_at(self) -> tuple[float, float]:
        """Where a text that belongs to it can stand."""
        if self.form == "arms":
            return self.x + 0.71 * self.radius, self.y + 0.71 * self.radius
        return self.x, self.y + (self.radius + 0.18 if self.form == "ring" else 0.0)

    def displaced(self, motion: Motion, scale: float) -> tuple[float, float, float]:
        """Centre and rotation (rad) at phase 0 of the cycle."""
        return (
            self.x + scale * float(motion.x.real),
            self.y + scale * float(motion.y.real),
            scale * float(motion.u.real) / self.radius,
        )

    def outline(self, samples: int = 6) -> NDArray[np.float64]:
        """Closed outline about its own centre, (n, 2): a circle, with rounded teeth where it has some."""
        if self.teeth == 0:
            angle = np.linspace(0, 2 * np.pi, 97)
            return np.column_stack([np.cos(angle), np.sin(angle)]) * self.radius
        angle = np.linspace(0, 2 * np.pi, self.teeth * samples + 1)
        wave = np.clip(1.6 * np.cos(self.teeth * angle), -1, 1)
        r = self.radius * (1 if self.form == "ring" else 0.965) + 0.05 * wave
        return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


Move = Callable[[Sequence[Body], Mapping[str, complex]], dict[str, Motion]]


@dataclass(frozen=True)
class Drawing:
    """A rig in its plane.

    Attributes
    ----------
    bodies : tuple of Body
        Drawn in this order.
    reach : float
        Radius of a circle about the origin round all of them.
    move : callable
        ``move(bodies, values)``: motion of every body from what is known of a shape, by DOF without sign.
    directions : int
        How many directions there are to measure at a body.
    """

    bodies: tuple[Body, ...]
    reach: float
    move: Move
    directions: int = 3

    def motions(self, values: Mapping[str, complex]) -> dict[str, Motion]:
        """Motion of every body from the shape's entries; NaN entries and absent DOFs count as missing."""
        return self.move(self.bodies, {k: v for k, v in values.items() if np.isfinite(v)})

    def at_rest(self) -> dict[str, Motion]:
        """No motion, and none known."""
        return {body.name: Motion(0, 0, 0, ("x", "y", "u")) for body in self.bodies}

    def scale(self, moved: Mapping[str, Motion], share: float = 0.16) -> float:
        """Scale at which the largest motion of any body is `share` of the drawing's radius."""
        largest = max((max(abs(m.x), abs(m.y), abs(m.u)) for m in moved.values()), default=0.0)
        return share * self.reach / largest if largest > 0 else 0.0


Draw = Callable[[Sequence[str], bool], Drawing | None]
"""``draw(points, complete)``: the drawing for DOFs without sign, None for those of another rig; `complete` where they
are all coordinates of a model, not only what was measured."""


def no_drawing(points: Sequence[str], complete: bool) -> None:
    """A rig that has no drawing."""
