"""The accelerometers' mass, which the model leaves out."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.mechanics.assembly import Assembly, Mass

ALL = "all"


def _places(assembly: Assembly) -> tuple[str, ...]:
    return (*assembly.bodies, ALL)


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    bodies = assembly.bodies if place == ALL else (place,)
    # A sensor on the base circle adds m·r² to the inertia about the axis, so m to I/r² of u = r·θ.
    dofs = [d for body in bodies for d in assembly.coordinates(body)]
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
            "mass per body, on its base circle: added to m and to I/r²",
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="all frequencies a little low, most for light bodies",
    reference="ISO 7626-2:2015, mass loading by the transducer",
)
