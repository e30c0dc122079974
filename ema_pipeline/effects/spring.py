"""A spring to ground at a DOF or a body, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import (
    bodies_pairs_and_dofs,
    is_place,
    least_stiffness,
    place_rows,
    stiffness_scale,
)
from ema_pipeline.mechanics.assembly import Assembly, Spring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    rows = place_rows(assembly, place)
    return assembly.add(
        *(Spring(f"spring {i} at {place}", r, values["stiffness"]) for i, r in enumerate(rows))
    )


EFFECT = Effect(
    id="spring",
    title="spring to ground at a DOF or a body, or between two",
    parameters=(EffectParameter("stiffness", "N/m", 0.0, 1e5, 5e5, -1e9, 1e9, "added stiffness"),),
    find_places=bodies_pairs_and_dofs,
    edit=_edit,
    signs="frequencies of modes that strain it move",
    other_places=is_place,
    generic=True,
    scales=stiffness_scale,
    least=least_stiffness,
    records_order=60,
)
