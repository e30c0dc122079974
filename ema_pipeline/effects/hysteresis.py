"""Friction between the wires of an isolator: Bouc-Wen hysteresis."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import BoucWen


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["force"] == 0.0:
        return assembly
    row = isolator_row(assembly, place)
    shape = (values["rho"], values["sigma"], values["exponent"])
    return assembly.add(BoucWen(f"{place} hysteresis", row, values["force"], *shape))


EFFECT = Effect(
    id="hysteresis",
    title="Bouc-Wen hysteresis: loss that does not depend on frequency",
    parameters=(
        EffectParameter("force", "N", 0.0, 130.0, 200.0, 0.0, 1e7, "k_w, the force that it tends to"),
        EffectParameter(
            "rho", "1/m", 600.0, 600.0, 600.0, 1.0, 1e7, "k_w·rho is its stiffness at small motions"
        ),
        EffectParameter("sigma", "1", 0.5, 0.5, 0.5, 0.0, 5.0, "shape of the unloading branch"),
        EffectParameter("exponent", "1", 1.0, 1.0, 1.0, 1.0, 20.0, "n: the larger, the sharper the yield"),
    ),
    find_places=isolators,
    edit=_edit,
    signs="force loop with area at any frequency; stiffness falls as the amplitude grows",
    reference="F. Ikhouane, J. Rodellar, Systems with Hysteresis (2007), chapter 2",
    linear=False,
)
