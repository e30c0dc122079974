"""Sensors that are not ideal: own gains, and a share of the motion across their axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly, Row, combination
from ema_pipeline.simulate.imperfections import Imperfections, deviations, generator

HAMMER = "hammer"

_ACROSS: Mapping[str, tuple[tuple[str, float], ...]] = {
    "x": (("y", 1.0), ("z", 1.0)),
    "y": (("x", -1.0), ("z", 1.0)),
    "z": (("x", 1.0), ("y", 1.0)),
    "zeta": (("eta", 1.0),),
    "eta": (("zeta", -1.0),),
}
"""Directions across, the first that a body has is taken: a quarter turn ahead."""

_PLANES = (("x", "y"), ("zeta", "eta"))
_TURNING = "u"
"""Motion along the rim; across it is the radius."""


@dataclass(frozen=True)
class ChannelDraw:
    """What one channel truly is.

    Attributes
    ----------
    gain : float
        Reading over what the stated sensitivity makes of it.
    transverse : float
        Share of the perpendicular motion in the reading.
    angle_rad : float
        Where on the rim a sensor of rotation sits.
    """

    gain: float = 1.0
    transverse: float = 0.0
    angle_rad: float = 0.0


def draw_channels(points: Iterable[str], sizes: Imperfections, seed: int) -> dict[str, ChannelDraw]:
    """What the channels truly are; a sensor is the same one in all configurations.

    Parameters
    ----------
    points : iterable of str
        DOFs without sign.
    sizes : Imperfections
    seed : int

    Returns
    -------
    dict of str to ChannelDraw
        By DOF, and for the hammer.
    """
    names = [HAMMER, *dict.fromkeys(points)]
    gains = deviations(generator(seed, "gains"), len(names))
    shares = deviations(generator(seed, "transverse"), len(names))
    angles = generator(seed, "sensor angle").uniform(-np.pi, np.pi, len(names))
    return {
        name: ChannelDraw(
            float(np.exp(sizes.calibration * gain)),
            0.0 if name == HAMMER else sizes.transverse * share,
            float(angle),
        )
        for name, gain, share, angle in zip(names, gains, shares, angles, strict=True)
    }


def across(assembly: Assembly, dof: Dof, angle_rad: float) -> Row:
    """Row of the in-plane direction perpendicular to a DOF on its body; empty where the body has none.

    Across a rotation is the radial direction at `angle_rad` on the rim.
    """
    if dof.direction == _TURNING:
        for pair in _PLANES:
            turned = zip(pair, (np.cos(angle_rad), np.sin(angle_rad)), strict=True)
            terms = [
                (float(share), assembly.row(f"{dof.body}.{d}"))
                for d, share in turned
                if assembly.has_dof(f"{dof.body}.{d}")
            ]
            if terms:
                return combination(*terms)
        return {}
    for direction, sign in _ACROSS.get(dof.direction, ()):
        if assembly.has_dof(f"{dof.body}.{direction}"):
            return combination((sign, assembly.row(f"{dof.body}.{direction}")))
    return {}


def with_sensors(
    assembly: Assembly, sensors: Sequence[Dof], channels: Mapping[str, ChannelDraw]
) -> tuple[Assembly, tuple[Dof, ...]]:
    """The assembly with places that move as the sensors read, gains aside, and these places."""
    rows: dict[str, Row] = {}
    places = []
    for i, sensor in enumerate(sensors):
        channel = channels[sensor.point]
        place = Dof("_sensor", f"n{i}", sensor.sign)
        beside = across(assembly, sensor, channel.angle_rad)
        rows[place.point] = combination((1.0, assembly.row(sensor.point)), (channel.transverse, beside))
        places.append(place)
    return dataclasses.replace(assembly, sensors={**assembly.sensors, **rows}), tuple(places)
