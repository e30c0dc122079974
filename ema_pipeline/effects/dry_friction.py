"""Coulomb friction of a body, or at a DOF, against ground, or between two."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_joints_and_dofs, is_place, place_rows
from ema_pipeline.effects.isolators import isolators
from ema_pipeline.effects.places import bodies_with_bearings
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import DryFriction


def _places(assembly: Assembly) -> tuple[str, ...]:
    """Bodies on bearings; bodies, joints and DOFs of a rig that names neither bearings nor isolators."""
    own = bodies_with_bearings(assembly)
    return own if own or isolators(assembly) else bodies_joints_and_dofs(assembly)


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["force"] == 0.0:
        return assembly
    return assembly.add(
        *(
            DryFriction(f"{place} friction {i}", row, values["force"], values["velocity"])
            for i, row in enumerate(place_rows(assembly, place))
        )
    )


EFFECT = Effect(
    id="dry_friction",
    title="Coulomb friction against ground, or between two",
    parameters=(
        EffectParameter("force", "N", 0.0, 2.0, 10.0, 0.0, 1e5, "Coulomb force in each direction"),
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
    find_places=_places,
    edit=_edit,
    signs="damping falls as the hammer's force grows; distorted circles at low force",
    reference="K. Worden, G. R. Tomlinson, Nonlinearity in Structural Dynamics (2001), chapter 2",
    linear=False,
    other_places=is_place,
    records_order=30,
)
