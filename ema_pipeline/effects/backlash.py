"""Free play of an isolator: it moves a little without any force."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_spring, isolators
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring
from ema_pipeline.mechanics.laws import LooseSpring, PartingSpring

_MOUNT = ".mount"
"""Ending of the places where the isolator is loose as a whole: in the play none of its elements acts."""


def _places(assembly: Assembly) -> tuple[str, ...]:
    springs = isolators(assembly)
    return (*springs, *(place + _MOUNT for place in springs))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    gap = values["gap"]
    if gap == 0.0:
        return assembly
    kind = LooseSpring if place.endswith(_MOUNT) else PartingSpring

    def let_play(element: Element) -> Element:
        assert isinstance(element, Spring)
        # Counted from the middle of the play.
        return kind(
            element.name, element.row, element.stiffness, element.loss_factor, preload=-0.5 * gap, gap=gap
        )

    return assembly.edit([isolator_spring(place.removesuffix(_MOUNT))], let_play)


EFFECT = Effect(
    id="backlash",
    title="free play: motion without force where the force changes its sign",
    parameters=(EffectParameter("gap", "m", 0.0, 1e-4, 1e-3, 0.0, 1.0, "total free play"),),
    find_places=_places,
    edit=_edit,
    signs="flat parts of the force loop at zero force after each reversal, of one length at all amplitudes",
    reference="A. Gelb, W. E. Vander Velde, Multiple-Input Describing Functions (1968), appendix B",
    linear=False,
)
