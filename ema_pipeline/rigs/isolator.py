"""A mass on a metal-mesh isolator, which the base model takes as a linear spring.

The effects at ``isolator`` add what the spring is missing. The same elements give the force loop where the
displacement is prescribed (see `ema_pipeline.loops`).

References
----------
F. Mezghani et al., "Experimental characterization of metal-mesh isolators damping capacity": stiffness K1.
The mass is ours: that source has none, because its tests prescribe the displacement.
"""

from __future__ import annotations

from collections.abc import Mapping

from ema_pipeline.mechanics.assembly import Assembly, Mass, Spring
from ema_pipeline.rigs.base import ParametricRig, RigKind
from ema_pipeline.rigs.types import Parameter

PLACE = "isolator"
SPRING = f"{PLACE} spring"


def default_parameters(geometry: Mapping[str, int] | None = None) -> dict[str, Parameter]:
    """K1 of the source under a mass of 2 kg."""
    known = (
        Parameter("mass", 2.0, "kg", 0.01),
        Parameter("stiffness", 9.702e4, "N/m", 0.0, 1e3, 1e8, free=True),
        Parameter("modal_damping_ratio", 0.0, "1", 0.0, 0.0, 0.5),
    )
    return {p.name: p for p in known}


def isolator(parameters: Mapping[str, Parameter] | None = None) -> ParametricRig:
    """The isolator rig with its sensor at ``mass.x``."""
    return ParametricRig("isolator", ("default",), default_parameters() | dict(parameters or {}), _build)


def _build(configuration: str, values: Mapping[str, float]) -> Assembly:
    row = {"mass.x": 1.0}
    elements = (Mass("mass mass x", row, values["mass"]), Spring(SPRING, row, values["stiffness"]))
    return Assembly(("mass.x",), elements, {}, values["modal_damping_ratio"])


def _make(geometry: Mapping[str, int], parameters: Mapping[str, Parameter]) -> ParametricRig:
    return isolator(parameters)


RIG = RigKind(
    name="isolator",
    title="mass on a metal-mesh isolator with hysteresis",
    make=_make,
    geometry={},
    parameters=default_parameters,
)
