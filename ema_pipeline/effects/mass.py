"""A mass at a DOF, or an inerter between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import coordinates, is_pair, place_row
from ema_pipeline.mechanics.assembly import Assembly, Mass


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Mass(f"mass at {place}", place_row(assembly, place), values["mass"]))


EFFECT = Effect(
    id="mass",
    title="mass at a DOF, or an inerter between two",
    parameters=(EffectParameter("mass", "kg", 0.0, 0.05, 0.1, -10.0, 1e3, "added mass"),),
    find_places=coordinates,
    edit=_edit,
    signs="frequencies of modes that move it fall",
    other_places=is_pair,
)
