"""The teeth of a mesh separate where the motion exceeds the preload."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import MESH, meshes
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring
from ema_pipeline.mechanics.laws import PartingSpring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    preload, gap = values["preload"], values["gap"]
    if preload == float("inf"):
        return assembly

    def let_part(element: Element) -> Element:
        assert isinstance(element, Spring)
        return PartingSpring(
            element.name,
            element.row,
            element.stiffness,
            element.loss_factor,
            element.part,
            preload=preload,
            gap=gap,
        )

    return assembly.edit([place + MESH], let_part)


EFFECT = Effect(
    id="mesh_backlash",
    title="teeth that separate where the motion exceeds the preload",
    parameters=(
        EffectParameter(
            "preload",
            "m",
            float("inf"),
            2e-6,
            1e-5,
            0.0,
            1e-2,
            "deflection of the mesh under its preload, beyond which the teeth separate",
        ),
        EffectParameter(
            "gap",
            "m",
            float("inf"),
            1e-4,
            1e-4,
            0.0,
            1e-1,
            "travel from separation to contact of the tooth backs",
        ),
    ),
    find_places=meshes,
    edit=_edit,
    signs="mesh modes fall as the hammer's force grows; coherence dips at their resonances",
    reference="A. Kahraman, R. Singh, J. Sound Vib. 142 (1990) 49-75",
    linear=False,
)
