"""A damper to ground at a DOF, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import coordinates, is_pair, place_row
from ema_pipeline.mechanics.assembly import Assembly, Damper


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Damper(f"damper at {place}", place_row(assembly, place), values["coefficient"]))


EFFECT = Effect(
    id="damper",
    title="viscous damper to ground at a DOF, or between two",
    parameters=(EffectParameter("coefficient", "N·s/m", 0.0, 20.0, 50.0, 0.0, 1e6, "damping coefficient"),),
    find_places=coordinates,
    edit=_edit,
    signs="damping of modes that move it rises",
    other_places=is_pair,
)
