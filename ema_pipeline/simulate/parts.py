"""Parts of a rig that are not exactly alike: every spring and every body has its own deviation."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from functools import partial

import numpy as np

from ema_pipeline.mechanics.assembly import Assembly, Element, Mass, Spring
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig
from ema_pipeline.simulate.altered import altered
from ema_pipeline.simulate.imperfections import deviations, generator

MASS_SHARE = 0.25
"""Masses scatter by this share of what stiffnesses do: bodies are weighed and machined, joints are not."""

TRANSLATIONS = ("x", "y", "z", "zeta", "eta")
"""Directions in which a body moves with one and the same mass."""


def parts_of(assembly: Assembly) -> dict[str, tuple[str, ...]]:
    """Parts by name, each with the names of its elements.

    An element may itself say which part it belongs to. Else every spring is a part of its own, and the masses of one
    body in its directions of translation are one part, ``"carrier mass"``; a second mass at the same DOF is another
    one. Springs without stiffness are no parts.
    """
    found: dict[str, tuple[str, ...]] = {}
    times: Counter[str] = Counter()
    for element in assembly.elements:
        stated = str(getattr(element, "part", ""))
        if isinstance(element, Spring) and element.stiffness != 0.0:
            part = stated or element.name
            found[part] = (*found.get(part, ()), element.name)
        elif isinstance(element, Mass):
            part = stated or _mass_part(element, times)
            found[part] = (*found.get(part, ()), element.name)
    return found


def _mass_part(mass: Mass, times: Counter[str]) -> str:
    places = [dof for dof, share in mass.row.items() if share]
    body, _, direction = places[0].rpartition(".")
    if len(places) > 1 or direction not in TRANSLATIONS:
        return mass.name
    times[places[0]] += 1
    number = times[places[0]]
    return f"{body} mass" if number == 1 else f"{body} mass {number}"


def draw_parts(rig: Rig, scatter: float, seed: int) -> dict[str, float]:
    """Factor of every part of a rig; a part that several configurations share is drawn once.

    Parameters
    ----------
    rig : Rig
        Without effects: the size of an effect is what it is said to be.
    scatter : float
        1 σ of ln stiffness.
    seed : int

    Returns
    -------
    dict of str to float
        Part to the factor of its stiffness or mass.
    """
    is_mass: dict[str, bool] = {}
    for configuration in rig.configurations:
        assembly = rig.assembly(configuration)
        for part, names in parts_of(assembly).items():
            is_mass.setdefault(part, isinstance(assembly.named(names[0]), Mass))
    drawn = deviations(generator(seed, "parts"), len(is_mass))
    return {
        part: float(np.exp(scatter * (MASS_SHARE if mass else 1.0) * z))
        for (part, mass), z in zip(is_mass.items(), drawn, strict=True)
    }


def scattered_rig(rig: Rig, factors: Mapping[str, float]) -> ParametricRig:
    """The rig with every part changed by its factor."""
    return altered(rig, partial(_scattered, dict(factors)))


def _scattered(factors: Mapping[str, float], configuration: str, assembly: Assembly) -> Assembly:
    of_element = {
        name: factors[part] for part, names in parts_of(assembly).items() for name in names if part in factors
    }
    return assembly.edit(of_element, lambda e: scaled(e, of_element[e.name]))


def scaled(element: Element, factor: float) -> Element:
    """A spring or mass with its value times `factor`; others as they are."""
    if isinstance(element, Spring):
        return dataclasses.replace(element, stiffness=factor * element.stiffness)
    if isinstance(element, Mass):
        return dataclasses.replace(element, value=factor * element.value)
    return element
