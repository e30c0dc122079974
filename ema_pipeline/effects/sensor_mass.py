"""The accelerometers' mass, which the model leaves out."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import ALL
from ema_pipeline.mechanics.assembly import Assembly, Mass


def _places(assembly: Assembly) -> tuple[str, ...]:
    return (*assembly.bodies, ALL)


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    bodies = assembly.bodies if place == ALL else (place,)
    # What a sensor adds to the inertia about the axis depends on its radius, which nobody states; near the
    # axis it is nothing. Bodies that only turn have nothing else to be added to: there it sits on the base circle.
    dofs: list[str] = []
    for body in bodies:
        own = assembly.coordinates(body)
        dofs += [d for d in own if not d.endswith(".u")] or own
    return assembly.add(*(Mass(f"{d} sensor mass", {d: 1.0}, values["mass"]) for d in dofs))


EFFECT = Effect(
    id="sensor_mass",
    title="accelerometer mass that the model leaves out",
    parameters=(
        EffectParameter(
            "mass",
            "kg",
            0.0,
            0.02,
            0.03,
            0.0,
            1.0,
            "mass per body: added to its translation (to I/r² of bodies that only turn)",
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="all frequencies a little low, most for light bodies",
    reference="ISO 7626-2:2015, mass loading by the transducer",
)
