"""The bearing of one planet is stiffer or softer than those of the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import planets
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring


def _places(assembly: Assembly) -> tuple[str, ...]:
    return tuple(p for p in planets(assembly) if assembly.springs(prefix=f"{p} bearing"))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    def mistune(element: Element) -> Element:
        assert isinstance(element, Spring)
        return dataclasses.replace(element, stiffness=element.stiffness * (1 + values["relative_change"]))

    return assembly.edit([s.name for s in assembly.springs(prefix=f"{place} bearing")], mistune)


EFFECT = Effect(
    id="planet_bearing_mistune",
    title="one planet's bearing stiffer or softer than the others",
    parameters=(
        EffectParameter(
            "relative_change", "1", 0.0, 0.2, 0.2, -0.95, 10.0, "relative change of the bearing stiffness"
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="mode pairs split; a low planet mode is concentrated on one planet",
    reference="D. R. Kiracofe, R. G. Parker, J. Vib. Acoust. 129 (2007) 1-16",
)
