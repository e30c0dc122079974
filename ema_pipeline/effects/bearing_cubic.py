"""A bearing gets stiffer, or softer, with its deflection."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import PolynomialSpring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["stiffness"] == 0.0:
        return assembly
    return assembly.add(
        *(
            PolynomialSpring(f"{place} cubic {a}", {f"{place}.{a}": 1.0}, cubic=values["stiffness"])
            for a in "xy"
        )
    )


EFFECT = Effect(
    id="bearing_cubic",
    title="a bearing whose stiffness changes with its deflection",
    parameters=(
        EffectParameter("stiffness", "N/m³", 0.0, 1e12, 1e13, -1e18, 1e18, "cubic stiffness in x and in y"),
    ),
    find_places=bodies_with_bearings,
    edit=_edit,
    signs="natural frequency moves with the hammer's force, damping does not; third harmonics",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
)
