"""A bearing is stiffer along one direction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly, Spring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    bearing = assembly.named(f"{place} bearing x")
    assert isinstance(bearing, Spring)
    angle = np.deg2rad(values["angle_deg"])
    row = {f"{place}.x": float(np.cos(angle)), f"{place}.y": float(np.sin(angle))}
    extra = values["relative_stiffness"] * bearing.stiffness
    axis = Spring(f"{place} bearing principal axis", row, extra, part=bearing.part or bearing.name)
    return assembly.add(axis)


EFFECT = Effect(
    id="bearing_anisotropy",
    title="a bearing stiffer along one axis",
    parameters=(
        EffectParameter(
            "relative_stiffness", "1", 0.0, 0.3, 0.3, 0.0, 10.0, "extra stiffness along the axis, relative"
        ),
        EffectParameter("angle_deg", "deg", 0.0, 0.0, 90.0, -90.0, 90.0, "angle of the stiff axis from x"),
    ),
    find_places=bodies_with_bearings,
    edit=_edit,
    signs="x and y of one body differ; its translational pair splits",
)
