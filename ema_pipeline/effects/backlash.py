"""Free play of an isolator: it moves a little without any force."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_spring, isolators
from ema_pipeline.mechanics.assembly import Assembly, Element, Spring
from ema_pipeline.mechanics.laws import LooseSpring, PartingSpring

_ALONE = ".spring"
"""Ending of the places where the spring alone has the play, and the elements beside it go on in it."""


def _places(assembly: Assembly) -> tuple[str, ...]:
    whole = isolators(assembly)
    return (*whole, *(place + _ALONE for place in whole))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    gap = values["gap"]
    if gap == 0.0:
        return assembly
    kind = PartingSpring if place.endswith(_ALONE) else LooseSpring

    def let_play(element: Element) -> Element:
        assert isinstance(element, Spring)
        # Counted from the middle of the play.
        return kind(
            element.name, element.row, element.stiffness, element.loss_factor, preload=-0.5 * gap, gap=gap
        )

    return assembly.edit([isolator_spring(place.removesuffix(_ALONE))], let_play)


EFFECT = Effect(
    id="backlash",
    title="free play: motion at no force where the force changes its sign",
    parameters=(EffectParameter("gap", "m", 0.0, 1e-4, 1e-3, 0.0, 1.0, "whole way of the free play"),),
    find_places=_places,
    edit=_edit,
    signs="flat parts of the force loop at zero force after each reversal, of one length at all amplitudes",
    reference="A. Gelb, W. E. Vander Velde, Multiple-Input Describing Functions (1968), appendix B",
    linear=False,
)
