"""A shaft holds a body against rotation that the base model lets turn freely."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import is_planet
from ema_pipeline.mechanics.assembly import Assembly, Spring


def _places(assembly: Assembly) -> tuple[str, ...]:
    held = {e.name for e in assembly.springs(suffix=" bearing u") if e.stiffness > 0}
    return tuple(
        b
        for b in assembly.bodies
        if f"{b}.u" in assembly.dofs and not is_planet(b) and f"{b} bearing u" not in held
    )


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    return assembly.add(Spring(f"{place} shaft torsion", {f"{place}.u": 1.0}, values["stiffness"]))


EFFECT = Effect(
    id="shaft_torsion",
    title="torsional stiffness to ground that the base model takes as zero",
    parameters=(
        EffectParameter(
            "stiffness", "N/m", 0.0, 1e5, 3e5, 0.0, 1e9, "torsional stiffness at the base radius, k_θ/r²"
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="a rigid-body mode is not at 0 Hz; rotational modes rise, translational ones stay",
)
