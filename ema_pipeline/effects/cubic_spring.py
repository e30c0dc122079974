"""A spring whose force grows with the cube of its stretch, to ground at a DOF or a body, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_pairs_and_dofs, is_place, with_polynomial_springs
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly


def _places(assembly: Assembly) -> tuple[str, ...]:
    """Bodies on bearings are left out: `bearing_cubic` is the same there."""
    own = bodies_with_bearings(assembly)
    return tuple(p for p in bodies_pairs_and_dofs(assembly) if p not in own)


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return with_polynomial_springs(assembly, place, "cubic spring", cubic=values["stiffness"])


EFFECT = Effect(
    id="cubic_spring",
    title="spring whose force grows with the cube of its stretch",
    parameters=(EffectParameter("stiffness", "N/m³", 0.0, 1e12, 1e13, -1e18, 1e18, "cubic stiffness"),),
    find_places=_places,
    edit=_edit,
    signs="frequencies of modes that strain it move with the force; third harmonics",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
    other_places=is_place,
    generic=True,
    records_order=10,
)
