"""Foam, cords or rubber that carry the whole structure, where the model hangs free."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.generic import moved_mass
from ema_pipeline.effects.places import ALL
from ema_pipeline.mechanics.assembly import Assembly, Spring

USUAL_HZ = 8.0
"""Natural frequency on a usual suspension, by which its stiffness is known beforehand (1 σ about none)."""

_HELD = 1e-9
"""Stiffness against a common translation, over that of all springs, from which something holds the structure."""
_DIRECTIONS = ("x", "y", "z")


def _carried(assembly: Assembly) -> dict[str, float]:
    """Mass that moves along every translation in the fixed frame, kg, by DOF."""
    dofs = [d for d in assembly.dofs if d.rpartition(".")[2] in _DIRECTIONS]
    masses = {d: moved_mass(assembly, {d: 1.0}) for d in dofs}
    return {dof: mass for dof, mass in masses.items() if mass > 0}


def _places(assembly: Assembly) -> tuple[str, ...]:
    """All of a structure that moves freely along one direction."""
    total = sum(abs(s.stiffness) for s in assembly.springs())
    for direction in {d.rpartition(".")[2] for d in _carried(assembly)}:
        held = sum(
            abs(s.stiffness) * sum(v for d, v in s.row.items() if d.endswith(f".{direction}")) ** 2
            for s in assembly.springs()
        )
        if held <= _HELD * total:
            return (ALL,)
    return ()


def _edit(assembly: Assembly, place: str, values: Mapping[str, float]) -> Assembly:
    masses = _carried(assembly)
    whole = _moved(masses)
    springs = (
        Spring(f"suspension at {dof}", {dof: 1.0}, values["stiffness"] * mass / whole)
        for dof, mass in masses.items()
    )
    return assembly.add(*springs)


def _moved(masses: Mapping[str, float]) -> float:
    """Largest mass that moves along one direction, kg."""
    return max(sum(m for d, m in masses.items() if d.endswith(f".{one}")) for one in _DIRECTIONS)


def _scale(assembly: Assembly, place: str) -> Mapping[str, float]:
    return {"stiffness": (2 * np.pi * USUAL_HZ) ** 2 * _moved(_carried(assembly))}


EFFECT = Effect(
    id="suspension",
    title="soft suspension of the whole structure (foam, cords), which the model leaves out",
    parameters=(
        EffectParameter(
            "stiffness", "N/m", 0.0, 1e4, 1e4, 0.0, 1e9,
            "of the whole suspension along one direction, shared by the bodies as their masses are",
        ),
    ),
    find_places=_places,
    edit=_edit,
    signs="rigid-body modes are not at 0 Hz, and the lowest others a little high",
    reference="D. J. Ewins, Modal Testing, 2nd ed. (2000), section 3.3.2",
    other_places=lambda assembly, place: place == ALL and bool(_carried(assembly)),
    generic=True,
    scales=_scale,
)  # fmt: skip
