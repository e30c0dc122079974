"""Torsional planetary gearbox: sun, carrier and N planets that only turn; the ring is fixed.

Coordinates u = r·θ: sun and planets at their base radii, the carrier at the circle of the planets' centres.
The mesh deflections of the source are δ_sp = r_s θ_s + r_p θ_p - r_c cos α θ_c and
δ_rp = -r_p θ_p - r_c cos α θ_c; they are those of `rigs.planetary` with every centre held and the carrier
rigid.

The source prints no parameter values. The default ones take the bodies of the `planetary` rig (the carrier
with its planets: 2.41 kg + 3 · 0.43 kg), its average mesh stiffness of 12.5 MN/m, and 1 % damping of the
planet modes at 1.66 kHz: 0.7 % from the dampers of the meshes, and 0.3 %, known to half of it, that bearings
and shafts give to every mode, also to one that strains no mesh. A mesh is linear at its preload;
`mesh_backlash` lets it part.

References
----------
I. Manarikkal, F. Elasha, D. S. Laila, D. Mba, "Dynamic modelling of planetary gearboxes with cracked tooth
using vibrational analysis", Eqs. 1-7.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Row, Spring
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs import gear_set
from ema_pipeline.rigs.base import Families, ParametricRig, RigKind, check_count
from ema_pipeline.rigs.types import Parameter

_SINGLE = re.compile(r"planet(?P<a>\d+)_inertia$|(sun|ring)_planet(?P<b>\d+)_mesh_stiffness$")


def default_parameters(geometry: Mapping[str, int] | None = None) -> dict[str, Parameter]:
    """The plausible set that the module's head explains."""
    known = (
        Parameter("sun_inertia", 1.00, "kg", 0.03),
        Parameter("planet_inertia", 0.23, "kg", 0.03),
        Parameter("carrier_inertia", 3.70, "kg", 0.03),
        Parameter("sun_planet_mesh_stiffness", 1.25e7, "N/m", 0.0, 1e6, 1e9, free=True),
        Parameter("ring_planet_mesh_stiffness", 1.25e7, "N/m", 0.0, 1e6, 1e9, free=True),
        Parameter("mesh_damping", 17.0, "N·s/m", 0.3, 0.0, 1e5),
        Parameter("pressure_angle_deg", 20.0, "deg", 0.0, 0.0, 45.0),
        Parameter("modal_damping_ratio", 0.003, "1", 0.5, 0.0, 0.5),
    )
    return {p.name: p for p in known}


def extra_parameter(name: str, geometry: Mapping[str, int]) -> Parameter | None:
    """A single planet's inertia or mesh stiffness, which a rig file may add; None for an unknown name."""
    match = _SINGLE.match(name)
    if match is None or not 1 <= int(match["a"] or match["b"]) <= geometry["planets"]:
        return None
    base = default_parameters()[re.sub(r"planet\d+", "planet", name)]
    return Parameter(name, base.value, base.unit, base.tolerance, base.minimum, base.maximum, base.free)


def gearbox(planets: int = 3, parameters: Mapping[str, Parameter] | None = None) -> ParametricRig:
    """The gearbox rig with sensors at ``sun.u``, ``carrier.u`` and ``planetN.u``.

    Raises
    ------
    EmaError
        For fewer than two planets, or far too many.
    """
    check_count("gearbox", "planets", planets, 2)
    return ParametricRig(
        name="gearbox",
        configurations=("default",),
        parameters=default_parameters() | dict(parameters or {}),
        build=partial(_build, planets),
        classifier=partial(classify, planets),
    )


def mesh_row(gear: str, planet: int, alpha: float) -> Row:
    """Deflection of the mesh of `gear` (``"sun"`` or ``"ring"``) and a planet along the line of action."""
    row = {"carrier.u": -float(np.cos(alpha)), f"planet{planet}.u": 1.0 if gear == "sun" else -1.0}
    return {"sun.u": 1.0} | row if gear == "sun" else row


def _build(planets: int, configuration: str, values: Mapping[str, float]) -> Assembly:
    """Elements are named ``sun mass u``, ``sun-planet1 mesh``, ``sun-planet1 mesh damper`` …"""
    alpha = float(np.deg2rad(values["pressure_angle_deg"]))
    bodies = ("carrier", "sun", *(f"planet{n}" for n in range(1, planets + 1)))
    elements: list[Element] = []
    for body in bodies:
        general = re.sub(r"\d+$", "", body)
        inertia = values.get(f"{body}_inertia", values[f"{general}_inertia"])
        elements.append(Mass(f"{body} mass u", {f"{body}.u": 1.0}, inertia))
    for n in range(1, planets + 1):
        for gear in ("sun", "ring"):
            row = mesh_row(gear, n, alpha)
            stiffness = values.get(
                f"{gear}_planet{n}_mesh_stiffness", values[f"{gear}_planet_mesh_stiffness"]
            )
            elements.append(Spring(f"{gear}-planet{n} mesh", row, stiffness))
            elements.append(Damper(f"{gear}-planet{n} mesh damper", row, values["mesh_damping"]))
    dofs = tuple(f"{body}.u" for body in bodies)
    return Assembly(dofs, tuple(elements), {}, values["modal_damping_ratio"])


def classify(
    planets: int,
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    shapes: NDArray[np.float64],
) -> Families:
    """``"rotational"`` where sun and carrier turn, ``"planet"`` where the planets turn against each other.

    Half of the kinetic energy or more in the planets' differences makes a planet mode.
    """
    at = [system.dofs.index(f"planet{n}.u") for n in range(1, planets + 1)]
    families = []
    for f, shape in zip(frequency_hz, shapes.T, strict=True):
        apart = np.zeros(len(shape))
        apart[at] = shape[at] - np.mean(shape[at])
        share = (apart @ system.mass @ apart) / (shape @ system.mass @ shape)
        families.append("rigid body" if f == 0.0 else "planet" if share > 0.5 else "rotational")
    return tuple(families), shapes


def _make(geometry: Mapping[str, int], parameters: Mapping[str, Parameter]) -> ParametricRig:
    return gearbox(geometry["planets"], parameters)


RIG = RigKind(
    name="gearbox",
    title="torsional planetary gearbox: sun, carrier and N planets that turn, ring fixed",
    make=_make,
    geometry={"planets": 3},
    parameters=default_parameters,
    extra=extra_parameter,
    drawing=gear_set.torsional,
)
