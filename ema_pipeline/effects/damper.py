"""A damper to ground at a DOF or a body, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_pairs_and_dofs, damping_scale, is_place, place_rows
from ema_pipeline.mechanics.assembly import Assembly, Damper


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    rows = place_rows(assembly, place)
    return assembly.add(
        *(Damper(f"damper {i} at {place}", r, values["coefficient"]) for i, r in enumerate(rows))
    )


EFFECT = Effect(
    id="damper",
    title="viscous damper to ground at a DOF or a body, or between two",
    parameters=(EffectParameter("coefficient", "N·s/m", 0.0, 20.0, 50.0, 0.0, 1e6, "damping coefficient"),),
    find_places=bodies_pairs_and_dofs,
    edit=_edit,
    signs="damping of modes that move it rises",
    other_places=is_place,
    generic=True,
    scales=damping_scale,
    records_order=80,
)
