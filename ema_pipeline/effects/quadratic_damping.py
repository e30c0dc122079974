"""A damper whose force grows with the square of its rate, like that of a displaced fluid."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_pairs_and_dofs, is_place, place_rows
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.dissipation import SquareDamper


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["coefficient"] == 0.0:
        return assembly
    return assembly.add(
        *(
            SquareDamper(f"quadratic damper {i} at {place}", r, values["coefficient"])
            for i, r in enumerate(place_rows(assembly, place))
        )
    )


EFFECT = Effect(
    id="quadratic_damping",
    title="damper whose force grows with the square of its rate",
    parameters=(
        EffectParameter("coefficient", "N·s²/m²", 0.0, 1.0, 10.0, 0.0, 1e9, "factor of rate × |rate|"),
    ),
    find_places=bodies_pairs_and_dofs,
    edit=_edit,
    signs="damping that grows with the level",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
    other_places=is_place,
    generic=True,
    records_only=True,
    records_order=50,
)
