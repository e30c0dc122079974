"""An isolator that gets stiffer, or softer, with its deflection."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import PolynomialSpring


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["stiffness"] == 0.0:
        return assembly
    row = isolator_row(assembly, place)
    return assembly.add(PolynomialSpring(f"{place} cubic", row, cubic=values["stiffness"]))


EFFECT = Effect(
    id="cubic_stiffness",
    title="stiffness that changes with the amplitude",
    parameters=(
        EffectParameter("stiffness", "N/m³", 0.0, 1e9, 1e10, -1e16, 1e16, "factor K3 of the cube of x"),
    ),
    find_places=isolators,
    edit=_edit,
    signs="force loop bends up or down at both ends; third harmonics",
    reference="F. Mezghani et al., Experimental characterization of metal-mesh isolators, Eq. 3",
    linear=False,
)
