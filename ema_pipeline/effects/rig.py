"""A rig with effects: the base rig's parameters and those of the effects, as one rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from ema_pipeline.effects.base import PlacedEffect, effect_of
from ema_pipeline.effects.library import Library, parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig

EffectWithValues = tuple[str, Mapping[str, float]]


def rig_with_effects(
    rig: Rig, effects: Sequence[EffectWithValues | str], library: Library | None = None
) -> ParametricRig:
    """The rig with effects added, in their order.

    The effects' parameters join the rig's as free parameters named ``id@place.name``. In a configuration that
    lacks the place (a ring mesh without a ring) an effect is simply absent.

    Parameters
    ----------
    rig : Rig
    effects : sequence of (label, values) or label
        ``("mesh_stiffness_loss@sun-planet1", {"fraction": 0.35})``; start values where left out.
    library : dict of str to Effect, optional
        The shipped effects where left out.

    Raises
    ------
    EmaError
        For unknown effects, places and parameters, and an effect that is named twice.
    """
    parameters = dict(rig.parameters)
    placed: list[PlacedEffect] = []
    current: ParametricRig | Rig = rig
    for item in effects:
        label, values = (item, {}) if isinstance(item, str) else item
        one = parse_effect(label, current, library=library)
        if any(one.label == other.label for other in placed):
            raise EmaError(f"effect '{one.label}' is named twice; name it once")
        placed.append(one)
        parameters |= one.parameters(values)
        # Later effects may sit on what earlier ones add.
        current = ParametricRig(
            name=rig.name,
            configurations=rig.configurations,
            parameters=dict(parameters),
            build=partial(_build, rig, tuple(placed)),
            uses=partial(_uses, rig, tuple(placed)),
            classifier=rig.classify,
            modal_damping_scatter=rig.modal_damping_scatter,
            stiffness_steps=rig.stiffness_steps,
        )
    if isinstance(current, ParametricRig):
        return current
    return ParametricRig(
        rig.name,
        rig.configurations,
        parameters,
        partial(_build, rig, ()),
        partial(_uses, rig, ()),
        rig.classify,
        rig.modal_damping_scatter,
        rig.stiffness_steps,
    )


def _build(
    rig: Rig, placed: tuple[PlacedEffect, ...], configuration: str, values: Mapping[str, float]
) -> Assembly:
    assembly = rig.assembly(configuration, {n: v for n, v in values.items() if n in rig.parameters})
    for one in placed:
        if one.effect.fits(assembly, one.place):
            own = {p.name: values[one.parameter_name(p.name)] for p in one.effect.parameters}
            assembly = one.effect.edit(assembly, one.place, own)
    return assembly


def _uses(rig: Rig, placed: tuple[PlacedEffect, ...], configuration: str, name: str) -> bool:
    if name in rig.parameters:
        return name in rig.used(configuration)
    label = effect_of(name)
    assembly = rig.assembly(configuration)
    for one in placed:
        fits = one.effect.fits(assembly, one.place)
        if one.label == label:
            return fits
        if fits:
            assembly = one.effect.edit(assembly, one.place, {p.name: p.start for p in one.effect.parameters})
    return False
