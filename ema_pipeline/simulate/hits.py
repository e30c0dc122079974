"""Hits that differ: each has its own direction, and finds the rig at its own natural frequencies."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly, Spring, combination
from ema_pipeline.simulate.imperfections import DriftKind, Imperfections
from ema_pipeline.simulate.parts import scaled
from ema_pipeline.simulate.sensing import across

STRUCK = Dof("_hammer", "n0")


@dataclass(frozen=True)
class HitDraw:
    """One hit.

    Attributes
    ----------
    aim_deg : float
        Angle of the blow to its DOF, in the plane of the body.
    frequency_factor : float
        Natural frequencies during the hit over those of the rig.
    """

    aim_deg: float = 0.0
    frequency_factor: float = 1.0


class HitSeries:
    """Draws the hits of one configuration, one after the other.

    Parameters
    ----------
    sizes : Imperfections
    kind : str
        ``"independent"``: frequencies deviate anew at each hit. ``"walk"``: each hit adds its deviation to the last
        one's, as a rig does that warms up.
    random : numpy Generator
    """

    def __init__(self, sizes: Imperfections, kind: DriftKind, random: np.random.Generator) -> None:
        self._sizes, self._kind, self._random = sizes, kind, random
        self._deviation = 0.0

    def draw(self) -> HitDraw:
        """The next hit."""
        aim, step = self._random.standard_normal(2)
        before = self._deviation if self._kind == "walk" else 0.0
        self._deviation = before + self._sizes.drift * float(step)
        return HitDraw(self._sizes.aim_deg * float(aim), 1.0 + self._deviation)


def as_struck(assembly: Assembly, impact: Dof, hit: HitDraw, rim_angle_rad: float) -> tuple[Assembly, Dof]:
    """The assembly as a hit finds it, and the place that is struck.

    Parameters
    ----------
    assembly : Assembly
    impact : Dof
    hit : HitDraw
        Its drift changes all springs: factor² on every stiffness. Viscous dampers stay.
    rim_angle_rad : float
        Where on the rim a blow at a rotation lands.
    """
    if hit.frequency_factor != 1.0:
        springs = [e.name for e in assembly.elements if isinstance(e, Spring)]
        assembly = assembly.edit(springs, lambda e: scaled(e, hit.frequency_factor**2))
    aim = np.deg2rad(hit.aim_deg)
    beside = across(assembly, impact, rim_angle_rad)
    row = combination((float(np.cos(aim)), assembly.row(impact.point)), (float(np.sin(aim)), beside))
    sensors = {**assembly.sensors, STRUCK.point: row}
    return dataclasses.replace(assembly, sensors=sensors), dataclasses.replace(STRUCK, sign=impact.sign)
