"""Coulomb friction between a body and ground."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import DryFriction


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["force"] == 0.0:
        return assembly
    return assembly.add(
        *(
            DryFriction(f"{place} friction {a}", {f"{place}.{a}": 1.0}, values["force"], values["velocity"])
            for a in "xy"
        )
    )


EFFECT = Effect(
    id="dry_friction",
    title="Coulomb friction of a body against ground",
    parameters=(
        EffectParameter("force", "N", 0.0, 2.0, 10.0, 0.0, 1e5, "Coulomb force in x and in y"),
        EffectParameter(
            "velocity",
            "m/s",
            1e-3,
            1e-3,
            1e-2,
            1e-6,
            1.0,
            "rate at which it has reached three quarters of that",
        ),
    ),
    find_places=bodies_with_bearings,
    edit=_edit,
    signs="damping falls as the hammer's force grows; distorted circles at low force",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
)
