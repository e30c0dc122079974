"""Material damping: a loss factor of some springs, in place of viscous dampers beside them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Spring


def _group(name: str) -> str | None:
    """Place that an element belongs to: ``sun-planet`` of a mesh, the body (planets as one) of a bearing."""
    match = re.match(r"(.+) (mesh|bearing)( |$)", name)
    return re.sub(r"planet\d+", "planet", match[1]) if match else None


def _places(assembly: Assembly) -> tuple[str, ...]:
    return tuple(dict.fromkeys(g for e in assembly.springs() if (g := _group(e.name)) is not None))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["loss_factor"] == 0.0:
        return assembly

    def change(element: Element) -> Element | None:
        if isinstance(element, Damper):
            return None
        assert isinstance(element, Spring)
        return dataclasses.replace(element, loss_factor=values["loss_factor"])

    names = [e.name for e in assembly.elements if isinstance(e, Spring | Damper) and _group(e.name) == place]
    return assembly.edit(names, change)


EFFECT = Effect(
    id="hysteretic_damping",
    title="loss factor of meshes or bearings in place of viscous damping",
    parameters=(
        EffectParameter("loss_factor", "1", 0.0, 0.03, 0.05, 0.0, 1.0, "imaginary over real stiffness"),
    ),
    find_places=_places,
    edit=_edit,
    signs="damping of the modes that strain these springs differs, equally at all frequencies",
    reference="D. J. Ewins, Modal Testing, 2nd ed. (2000), section 2.4",
)
