"""A shaft or a common housing ties two bodies to each other sideways."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly, Spring


def _places(assembly: Assembly) -> tuple[str, ...]:
    return tuple(f"{a}-{b}" for a, b in combinations(bodies_with_bearings(assembly), 2))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    a, b = place.split("-")
    return assembly.add(
        *(
            Spring(f"{place} coupling {axis}", {f"{a}.{axis}": 1.0, f"{b}.{axis}": -1.0}, values["stiffness"])
            for axis in ("x", "y")
        )
    )


EFFECT = Effect(
    id="shaft_coupling",
    title="lateral spring between two bodies",
    parameters=(EffectParameter("stiffness", "N/m", 0.0, 1e5, 5e5, 0.0, 1e9, "stiffness in x and in y"),),
    find_places=_places,
    edit=_edit,
    signs="translational modes of two bodies move together; rotational modes stay",
)
