"""A bearing whose stiffness differs between push and pull."""

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
            PolynomialSpring(f"{place} quadratic {a}", {f"{place}.{a}": 1.0}, quadratic=values["stiffness"])
            for a in "xy"
        )
    )


EFFECT = Effect(
    id="bearing_quadratic",
    title="a bearing whose stiffness differs between push and pull",
    parameters=(
        EffectParameter("stiffness", "N/m²", 0.0, 1e8, 1e9, -1e15, 1e15, "quadratic stiffness in x and in y"),
    ),
    find_places=bodies_with_bearings,
    edit=_edit,
    signs="second harmonics and a shift of the mean; natural frequency falls a little as the force grows",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
)
