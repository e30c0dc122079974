"""A viscous damper between one body and ground."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.places import bodies_in_plane, bodies_that_only_turn, plane_rows
from ema_pipeline.mechanics.assembly import Assembly, Damper


def _places(assembly: Assembly) -> tuple[str, ...]:
    return (*bodies_in_plane(assembly), *bodies_that_only_turn(assembly))


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if place in bodies_that_only_turn(assembly):
        return assembly.add(Damper(f"{place} damper u", {f"{place}.u": 1.0}, values["coefficient"]))
    rows = zip("xy", plane_rows(assembly, place), strict=True)
    return assembly.add(*(Damper(f"{place} damper {a}", row, values["coefficient"]) for a, row in rows))


EFFECT = Effect(
    id="local_damper",
    title="viscous damper to ground, in x and y (in u where a body only turns)",
    parameters=(
        EffectParameter("coefficient", "N·s/m", 0.0, 20.0, 50.0, 0.0, 1e6, "damping in each direction"),
    ),
    find_places=_places,
    edit=_edit,
    signs="damping of a few modes too high, their shapes complex",
)
