"""A parameter of the rig that is not what its drawing says, by more than its tolerance: named as what it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial

from ema_pipeline.effects.base import Effect, EffectParameter, PlacedEffect
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Spring
from ema_pipeline.rigs.types import Rig

ID = "out_of_tolerance"

Names = frozenset[str]


def tolerance_effect(rig: Rig, parameter: str) -> PlacedEffect:
    """The parameter off by an unknown share, as an effect whose place is its name.

    Raises
    ------
    EmaError
        If the rig has no such parameter, or no mass, stiffness or damper is proportional to it.
    """
    if parameter not in rig.parameters:
        raise EmaError(
            f"rig '{rig.name}' has no parameter '{parameter}'{did_you_mean(parameter, rig.parameters)}"
        )
    names = proportional_elements(rig, parameter)
    if not names:
        raise EmaError(f"no element of rig '{rig.name}' is proportional to parameter '{parameter}'")
    effect = Effect(
        id=ID,
        title="a parameter outside its tolerance",
        parameters=(
            EffectParameter(
                "relative_change", "1", 0.0, 0.3, 0.5, -0.9, 20.0, "relative change against the stated value"
            ),
        ),
        find_places=partial(_places, parameter, names),
        edit=partial(_edit, names),
        signs="frequencies of the modes that strain or move these parts are off together",
    )
    return PlacedEffect(effect, parameter)


def proportional_elements(rig: Rig, parameter: str) -> Names:
    """Names of the masses, springs and dampers whose value is proportional to a parameter."""
    nominal = rig.parameters[parameter].value
    found: set[str] = set()
    for configuration in rig.configurations:
        before = rig.assembly(configuration)
        after = rig.assembly(configuration, {parameter: 1.1 * nominal})
        for a, b in zip(before.elements, after.elements, strict=True):
            scaled = _scaled(a, 1.1)
            if a != b and scaled is not None and _close(scaled, b):
                found.add(a.name)
    return frozenset(found)


def _places(parameter: str, names: Names, assembly: Assembly) -> tuple[str, ...]:
    return (parameter,) if names & {e.name for e in assembly.elements} else ()


def _edit(names: Names, assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    def change(element: Element) -> Element:
        return _scaled(element, 1 + values["relative_change"]) or element

    return assembly.edit([e.name for e in assembly.elements if e.name in names], change)


def _scaled(element: Element, factor: float) -> Element | None:
    if isinstance(element, Mass):
        return dataclasses.replace(element, value=element.value * factor)
    if isinstance(element, Spring):
        return dataclasses.replace(element, stiffness=element.stiffness * factor)
    if isinstance(element, Damper):
        return dataclasses.replace(element, coefficient=element.coefficient * factor)
    return None


def _close(a: Element, b: Element) -> bool:
    """Equal but for rounding of the value."""
    for name in ("value", "stiffness", "coefficient"):
        if hasattr(a, name):
            left, right = getattr(a, name), getattr(b, name)
            return bool(abs(left - right) <= 1e-9 * abs(left)) and a.name == b.name
    return False
