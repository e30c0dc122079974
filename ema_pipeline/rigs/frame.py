"""A frame of storeys that move sideways: a chain of masses and storey stiffnesses, fixed at its base."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from ema_pipeline.mechanics.assembly import Assembly, Mass, Row, Spring, difference
from ema_pipeline.rigs.base import ParametricRig, RigKind, check_count
from ema_pipeline.rigs.types import Parameter


def default_parameters(geometry: Mapping[str, int]) -> dict[str, Parameter]:
    """Equal storeys of a bench-top frame: 5 kg plates on 2e5 N/m columns."""
    parameters: dict[str, Parameter] = {}
    for n in range(1, geometry["storeys"] + 1):
        mass, stiffness = f"storey{n}_mass", f"storey{n}_stiffness"
        parameters[mass] = Parameter(mass, 5.0, "kg", 0.01)
        parameters[stiffness] = Parameter(stiffness, 2e5, "N/m", 0.10)
    parameters["modal_damping_ratio"] = Parameter("modal_damping_ratio", 0.01, "1", 0.3, 0.0, 0.5)
    return parameters


def frame(storeys: int = 3, parameters: Mapping[str, Parameter] | None = None) -> ParametricRig:
    """The frame rig with sensors at ``storeyN.x``, storey 1 lowest.

    Raises
    ------
    EmaError
        For fewer than one storey, or far too many.
    """
    check_count("frame", "storeys", storeys, 1)
    return ParametricRig(
        name="frame",
        configurations=("default",),
        parameters=default_parameters({"storeys": storeys}) | dict(parameters or {}),
        build=partial(_build, storeys),
    )


def _build(storeys: int, configuration: str, values: Mapping[str, float]) -> Assembly:
    """Elements are named ``storey1 mass x`` and ``storey1 columns`` (to the storey below)."""
    elements: list[Mass | Spring] = []
    below: Row = {}
    for n in range(1, storeys + 1):
        row: Row = {f"storey{n}.x": 1.0}
        elements.append(Mass(f"storey{n} mass x", row, values[f"storey{n}_mass"]))
        elements.append(Spring(f"storey{n} columns", difference(row, below), values[f"storey{n}_stiffness"]))
        below = row
    dofs = tuple(f"storey{n}.x" for n in range(1, storeys + 1))
    return Assembly(dofs, tuple(elements), {}, values["modal_damping_ratio"])


def _make(geometry: Mapping[str, int], parameters: Mapping[str, Parameter]) -> ParametricRig:
    return frame(geometry["storeys"], parameters)


RIG = RigKind(
    name="frame",
    title="frame of N storeys that move sideways, fixed at the base",
    make=_make,
    geometry={"storeys": 3},
    parameters=default_parameters,
)
