"""A bearing sits on a support that moves: mass and stiffness of its own, and two further modes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Spring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["stiffness"] == float("inf"):
        return assembly
    for axis in ("x", "y"):
        support = f"{place}_support.{axis}"

        def onto_support(element: Element, support: str = support) -> Element:
            assert isinstance(element, Spring | Damper)
            return dataclasses.replace(element, row={**element.row, support: -1.0})

        seat = f"{place} bearing {axis}"
        names = [e.name for e in assembly.elements if e.name in (seat, f"{seat} damper")]
        assembly = assembly.edit(names, onto_support).add(
            Mass(f"{place}_support mass {axis}", {support: 1.0}, values["mass"]),
            Spring(f"{place}_support foot {axis}", {support: 1.0}, values["stiffness"]),
            dofs=(support,),
        )
    return assembly


EFFECT = Effect(
    id="flexible_support",
    title="the bearing's support has mass and stiffness of its own",
    parameters=(
        EffectParameter("mass", "kg", 0.0, 2.0, 5.0, 1e-3, 1e3, "mass of the support"),
        EffectParameter(
            "stiffness",
            "N/m",
            float("inf"),
            1e7,
            1e8,
            1e3,
            1e12,
            "stiffness of the support to ground, x and y",
        ),
    ),
    find_places=bodies_with_bearings,
    edit=_edit,
    signs="a measured mode with no partner in the model; translational modes of the body fall",
)
