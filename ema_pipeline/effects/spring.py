"""A spring to ground at a DOF, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import coordinates, is_pair, place_row
from ema_pipeline.mechanics.assembly import Assembly, Spring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Spring(f"spring at {place}", place_row(assembly, place), values["stiffness"]))


EFFECT = Effect(
    id="spring",
    title="spring to ground at a DOF, or between two",
    parameters=(EffectParameter("stiffness", "N/m", 0.0, 1e5, 5e5, -1e9, 1e9, "added stiffness"),),
    find_places=coordinates,
    edit=_edit,
    signs="frequencies of modes that strain it move",
    other_places=is_pair,
)
