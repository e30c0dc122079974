"""An isolator whose stiffness differs between pull and push."""

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
    return assembly.add(PolynomialSpring(f"{place} quadratic", row, quadratic=values["stiffness"]))


EFFECT = Effect(
    id="quadratic_stiffness",
    title="stiffness that differs between pull and push",
    parameters=(
        EffectParameter("stiffness", "N/m²", 0.0, -1e7, 3e7, -1e12, 1e12, "factor K2 of the square of x"),
    ),
    find_places=isolators,
    edit=_edit,
    signs="force loop asymmetric, more so at large amplitude; second harmonics",
    reference="F. Mezghani et al., Experimental characterization of metal-mesh isolators, Eq. 3",
    linear=False,
)
