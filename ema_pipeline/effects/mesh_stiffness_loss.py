"""One gear mesh has lost part of its stiffness: a cracked or spalled tooth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import MESH, meshes
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    def weaken(element: Element) -> Element:
        assert isinstance(element, Spring)
        return dataclasses.replace(element, stiffness=element.stiffness * (1 - values["fraction"]))

    return assembly.edit([place + MESH], weaken)


EFFECT = Effect(
    id="mesh_stiffness_loss",
    title="one mesh softer than the others (cracked or spalled tooth)",
    parameters=(
        EffectParameter(
            "fraction", "1", 0.0, 0.3, 0.3, 0.0, 0.99, "fraction of the mesh stiffness that is lost"
        ),
    ),
    find_places=meshes,
    edit=_edit,
    signs="mode pairs split and mesh modes fall; a mode is concentrated on one planet",
    reference="F. Chaari et al., Eur. J. Mech. A/Solids 25 (2006) 325-340",
)
