"""A mass at a DOF or a body, or an inerter between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import (
    bodies_and_lone_dofs,
    is_place,
    least_mass,
    mass_scale,
    place_rows,
)
from ema_pipeline.mechanics.assembly import Assembly, Mass


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    rows = place_rows(assembly, place)
    return assembly.add(*(Mass(f"mass {i} at {place}", r, values["mass"]) for i, r in enumerate(rows)))


EFFECT = Effect(
    id="mass",
    title="mass at a DOF or a body, or an inerter between two",
    parameters=(EffectParameter("mass", "kg", 0.0, 0.05, 0.1, -10.0, 1e3, "added mass", below=0.1),),
    find_places=bodies_and_lone_dofs,
    edit=_edit,
    signs="frequencies of modes that move it fall",
    other_places=is_place,
    generic=True,
    scales=mass_scale,
    least=least_mass,
    records_order=70,
)
