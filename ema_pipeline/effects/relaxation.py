"""A Maxwell branch beside an isolator's spring: loss that falls with frequency."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import Maxwell


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["stiffness"] == 0.0:
        return assembly
    row = isolator_row(assembly, place)
    return assembly.add(Maxwell(f"{place} relaxation", row, values["stiffness"], values["time"]))


EFFECT = Effect(
    id="relaxation",
    title="Maxwell branch: loss that falls with frequency",
    parameters=(
        EffectParameter("stiffness", "N/m", 0.0, 1e4, 3e4, 0.0, 1e9, "stiffness to fast motions"),
        EffectParameter("time", "s", 0.05, 0.05, 0.1, 1e-5, 1e3, "relaxation time: damper over spring"),
    ),
    find_places=isolators,
    edit=_edit,
    signs="energy per cycle falls as frequency rises; the stiffness rises a little",
    reference="R. M. Christensen, Theory of Viscoelasticity, 2nd ed. (1982), chapter 1",
    linear=False,
)
