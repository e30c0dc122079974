"""One planet is heavier than the others."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import planets
from ema_pipeline.mechanics.assembly import Assembly, Mass


def _axes(assembly: Assembly, planet: str) -> list[str]:
    return [d for d in assembly.coordinates(planet) if not d.endswith(".u")]


def _places(assembly: Assembly) -> tuple[str, ...]:
    return tuple(p for p in planets(assembly) if _axes(assembly, p))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    axes = _axes(assembly, place)
    return assembly.add(*(Mass(f"{d} mistuned mass", {d: 1.0}, values["mass"]) for d in axes))


EFFECT = Effect(
    id="planet_mass_mistune",
    title="one planet heavier than the others",
    parameters=(
        EffectParameter(
            "mass", "kg", 0.0, 0.04, 0.05, -0.2, 1.0, "mass added at the planet's centre (I/r² stays)"
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="mode pairs split; a mode is concentrated on one planet, more so at high frequency",
    reference="D. R. Kiracofe, R. G. Parker, J. Vib. Acoust. 129 (2007) 1-16",
)
