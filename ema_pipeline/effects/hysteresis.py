"""Bouc-Wen hysteresis: friction between the wires of an isolator, or at a DOF, a body or between two of any rig."""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import bodies_pairs_and_dofs, is_place, place_rows
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.dissipation import HystereticSpring
from ema_pipeline.mechanics.laws import BoucWen


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["force"] == 0.0:
        return assembly
    row = isolator_row(assembly, place)
    shape = (values["rho"], values["sigma"], values["exponent"])
    return assembly.add(BoucWen(f"{place} hysteresis", row, values["force"], *shape))


def _edit_anywhere(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    if values["stiffness"] == 0.0:
        return assembly
    shape = (values["stiffness"], values["force"], values["shape"], values["exponent"])
    return assembly.add(
        *(
            HystereticSpring(f"{place} hysteresis {i}", r, *shape)
            for i, r in enumerate(place_rows(assembly, place))
        )
    )


ANYWHERE = Effect(
    id="hysteresis",
    title="Bouc-Wen hysteresis: force that depends on the path of the motion",
    parameters=(
        EffectParameter("stiffness", "N/m", 0.0, 1e4, 1e5, 0.0, 1e12, "stiffness at small motions"),
        EffectParameter("force", "N", float("inf"), 10.0, 1.0, 1e-15, 1e12, "scale of the force"),
        EffectParameter(
            "shape", "1", 0.0, 0.0, 1.0, -20.0, 20.0, "below -1 loading hardens, above it yields"
        ),
        EffectParameter("exponent", "1", 1.0, 1.0, 1.0, 1.0, 20.0, "n: the larger, the sharper the yield"),
    ),
    find_places=bodies_pairs_and_dofs,
    edit=_edit_anywhere,
    signs="loops of force over displacement whose area does not depend on the rate",
    reference="Y.-K. Wen, J. Eng. Mech. Div. ASCE 102 (1976) 249-263",
    linear=False,
    other_places=is_place,
    generic=True,
    records_only=True,
)
"""The form whose loops may harden too, which the normalised form of an isolator does not have."""

EFFECT = Effect(
    id="hysteresis",
    title="Bouc-Wen hysteresis: loss that does not depend on frequency",
    parameters=(
        EffectParameter("force", "N", 0.0, 130.0, 200.0, 0.0, 1e7, "k_w, the limit of its force"),
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
    elsewhere=ANYWHERE,
    records_order=40,
)
