"""A spring whose force grows with the square of its stretch: stiffer one way than the other."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_pairs_and_dofs, is_place, with_polynomial_springs
from ema_pipeline.mechanics.assembly import Assembly


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return with_polynomial_springs(assembly, place, "quadratic spring", quadratic=values["stiffness"])


EFFECT = Effect(
    id="quadratic_spring",
    title="spring whose stiffness differs between pull and push",
    parameters=(EffectParameter("stiffness", "N/m²", 0.0, 1e8, 1e9, -1e15, 1e15, "quadratic stiffness"),),
    find_places=bodies_pairs_and_dofs,
    edit=_edit,
    signs="second harmonics, and a mean that moves with the level",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
    other_places=is_place,
    generic=True,
    records_only=True,
    records_order=20,
)
