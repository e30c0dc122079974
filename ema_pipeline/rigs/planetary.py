"""Planetary gear: carrier, ring, sun and N planets in the plane, three coordinates each.

Coordinates: x, y (fixed frame) and u = r·θ (at the base radius) of carrier, ring and sun; ζ (radial), η
(tangential) and u of planet n, which sits at ψ_n = 2π(n-1)/N. Every mesh and bearing is a spring along the
row of its stretch.

References
----------
J. Lin, R. G. Parker, "Analytical characterization of the unique properties of planetary gear free
vibration", *J. Vib. Acoust.* 121 (1999) 316-321. The rows give its table of natural frequencies.
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

SUN_PLANET, RING_PLANET = "sun_planet_mesh_stiffness", "ring_planet_mesh_stiffness"
CONFIGURATIONS = ("no_ring", "with_ring")
CENTRAL = ("carrier", "ring", "sun")

# Table I of K. A. Olanipekun, "Estimation of a planetary gear mesh stiffness: an approach based on minimising
# error function". Its "I/r²" rows are in kg, its torsional stiffness is at the base radius.
_TABLE = {
    "mass": {"carrier": 1.00, "ring": 4.30, "sun": 2.00, "planet": 0.43},
    "inertia": {"carrier": 2.41, "ring": 6.22, "sun": 1.00, "planet": 0.23},
    "bearing_stiffness": {"carrier": 0.95e6, "ring": 1.64e7, "sun": 1.025e6, "planet": 3.82e4},
    "torsional_stiffness": {"carrier": 0.0, "ring": 2.54e8, "sun": 0.0},
}
_UNIT = {"mass": "kg", "inertia": "kg", "bearing_stiffness": "N/m", "torsional_stiffness": "N/m"}
_TOLERANCE = {"mass": 0.01, "inertia": 0.03, "bearing_stiffness": 0.10, "torsional_stiffness": 0.10}

# What a rig file may add: viscous coefficients per bearing, and values for single planets.
_DAMPING = {f"{body}_bearing_damping" for body in (*CENTRAL, "planet")} | {
    f"{body}_torsional_damping" for body in CENTRAL
}
_SINGLE = re.compile(
    r"planet(?P<a>\d+)_(mass|inertia|bearing_stiffness|bearing_damping)$"
    r"|(sun|ring)_planet(?P<b>\d+)_mesh_stiffness$"
)


def default_parameters() -> dict[str, Parameter]:
    """Parameters with the nominal values and tolerances of the seed's rig."""
    parameters: dict[str, Parameter] = {}
    for quantity, values in _TABLE.items():
        for body, value in values.items():
            name = f"{body}_{quantity}"
            parameters[name] = Parameter(name, value, _UNIT[quantity], _TOLERANCE[quantity])
    for gear in ("sun", "ring"):
        name = f"{gear}_planet_mesh_stiffness"
        parameters[name] = Parameter(name, 1e7, "N/m", 0.0, 1e6, 1e9, free=True)
    parameters["pressure_angle_deg"] = Parameter("pressure_angle_deg", 20.0, "deg", 0.0, 0.0, 45.0)
    parameters["modal_damping_ratio"] = Parameter("modal_damping_ratio", 0.01, "1", 0.3, 0.0, 0.5)
    return parameters


def extra_parameter(name: str, planets: int) -> Parameter | None:
    """Parameter that a rig file may add to the default ones, with its unit; None for an unknown name."""
    if name in _DAMPING:
        return Parameter(name, 0.0, "N·s/m", 0.3)
    match = _SINGLE.match(name)
    if match is None or not 1 <= int(match["a"] or match["b"]) <= planets:
        return None
    general = re.sub(r"planet\d+", "planet", name)
    if general in _DAMPING:
        return Parameter(name, 0.0, "N·s/m", 0.3)
    base = default_parameters()[general]
    return Parameter(name, base.value, base.unit, base.tolerance, base.minimum, base.maximum, base.free)


def planetary(planets: int = 2, parameters: Mapping[str, Parameter] | None = None) -> ParametricRig:
    """The planetary rig.

    Parameters
    ----------
    planets : int
        Number of planets N ≥ 2, equally spaced.
    parameters : dict of str to Parameter, optional
        Parameters that replace or join the default ones (see `default_parameters`, `extra_parameter`).
        Viscous bearing coefficients without a `modal_damping_ratio` take its place.

    Raises
    ------
    EmaError
        For fewer than two planets, or far too many.
    """
    check_count("planetary rig", "planets", planets, 2)
    given = dict(parameters or {})
    complete = default_parameters() | given
    if any(re.sub(r"\d", "", n) in _DAMPING for n in given) and "modal_damping_ratio" not in given:
        complete["modal_damping_ratio"] = Parameter("modal_damping_ratio", 0.0, "1")
    return ParametricRig(
        name="planetary",
        configurations=CONFIGURATIONS,
        parameters=complete,
        build=partial(_build, planets),
        uses=_uses,
        classifier=partial(classify, planets),
        stiffness_steps=(("no_ring", SUN_PLANET), ("with_ring", RING_PLANET)),
    )


def _uses(configuration: str, name: str) -> bool:
    return configuration == "with_ring" or not name.startswith("ring_")


def planet_angle(number: int, planets: int) -> float:
    """ψ of planet `number` (from 1), rad."""
    return 2 * np.pi * (number - 1) / planets


def sun_mesh_row(planet: int, psi: float, alpha: float) -> Row:
    """Stretch of the sun-planet mesh along the line of action."""
    p, a = f"planet{planet}", psi - alpha
    return {
        "sun.x": -np.sin(a),
        "sun.y": np.cos(a),
        "sun.u": 1.0,
        f"{p}.zeta": -np.sin(alpha),
        f"{p}.eta": -np.cos(alpha),
        f"{p}.u": 1.0,
    }


def ring_mesh_row(planet: int, psi: float, alpha: float) -> Row:
    """Stretch of the ring-planet mesh along the line of action."""
    p, a = f"planet{planet}", psi + alpha
    return {
        "ring.x": -np.sin(a),
        "ring.y": np.cos(a),
        "ring.u": 1.0,
        f"{p}.zeta": np.sin(alpha),
        f"{p}.eta": -np.cos(alpha),
        f"{p}.u": -1.0,
    }


def planet_bearing_rows(planet: int, psi: float) -> dict[str, Row]:
    """Radial and tangential stretch between carrier and planet."""
    c, s, p = np.cos(psi), np.sin(psi), f"planet{planet}"
    return {
        "radial": {"carrier.x": c, "carrier.y": s, f"{p}.zeta": -1.0},
        "tangential": {"carrier.x": -s, "carrier.y": c, "carrier.u": 1.0, f"{p}.eta": -1.0},
    }


def _build(planets: int, configuration: str, values: Mapping[str, float]) -> Assembly:
    """Elements of one configuration.

    Names: ``carrier mass x``, ``carrier bearing x``, ``planet1 bearing radial``, ``sun-planet1 mesh`` …;
    effects find them by these names.
    """
    central = CENTRAL if configuration == "with_ring" else ("carrier", "sun")
    alpha = np.deg2rad(values["pressure_angle_deg"])
    dofs: list[str] = []
    elements: list[Element] = []
    sensors: dict[str, Row] = {}

    for body in central:
        dofs += [f"{body}.x", f"{body}.y", f"{body}.u"]
        stiffness, torsional = values[f"{body}_bearing_stiffness"], values[f"{body}_torsional_stiffness"]
        viscous = values.get(f"{body}_bearing_damping", 0.0)
        for axis, mass, k, c in (
            ("x", values[f"{body}_mass"], stiffness, viscous),
            ("y", values[f"{body}_mass"], stiffness, viscous),
            ("u", values[f"{body}_inertia"], torsional, values.get(f"{body}_torsional_damping", 0.0)),
        ):
            row = {f"{body}.{axis}": 1.0}
            part = f"{body} inertia" if axis == "u" else f"{body} mass"
            elements.append(Mass(f"{body} mass {axis}", row, mass, part))
            elements.append(
                Spring(f"{body} bearing {axis}", row, k, piece="" if axis == "u" else f"{body} bearing")
            )
            if c:
                elements.append(Damper(f"{body} bearing {axis} damper", row, c))

    for n in range(1, planets + 1):
        p, psi = f"planet{n}", planet_angle(n, planets)
        dofs += [f"{p}.zeta", f"{p}.eta", f"{p}.u"]

        def own(quantity: str, n: int = n) -> float:
            return values.get(f"planet{n}_{quantity}", values.get(f"planet_{quantity}", 0.0))

        for axis, quantity in (("zeta", "mass"), ("eta", "mass"), ("u", "inertia")):
            elements.append(Mass(f"{p} mass {axis}", {f"{p}.{axis}": 1.0}, own(quantity), f"{p} {quantity}"))
        for axis, stretch in planet_bearing_rows(n, psi).items():
            stiffness = own("bearing_stiffness")
            elements.append(Spring(f"{p} bearing {axis}", stretch, stiffness, piece=f"{p} bearing"))
            if own("bearing_damping"):
                elements.append(Damper(f"{p} bearing {axis} damper", stretch, own("bearing_damping")))
        for gear, mesh_row in (("sun", sun_mesh_row), ("ring", ring_mesh_row)):
            if gear in central:
                common = values[f"{gear}_planet_mesh_stiffness"]
                mesh = values.get(f"{gear}_planet{n}_mesh_stiffness", common)
                elements.append(Spring(f"{gear}-{p} mesh", mesh_row(n, psi, alpha), mesh))
        sensors[f"{p}.x"] = {f"{p}.zeta": float(np.cos(psi)), f"{p}.eta": float(-np.sin(psi))}
        sensors[f"{p}.y"] = {f"{p}.zeta": float(np.sin(psi)), f"{p}.eta": float(np.cos(psi))}

    return Assembly(tuple(dofs), tuple(elements), sensors, values["modal_damping_ratio"])


def classify(
    planets: int,
    system: LinearSystem,
    frequency_hz: NDArray[np.float64],
    shapes: NDArray[np.float64],
) -> Families:
    """Families of Lin & Parker: rotational, translational, planet; ``"rigid body"`` at 0 Hz.

    The symmetric rig's modes lie in three subspaces: rotational (central bodies only turn, all planets move
    alike), translational (central bodies do not turn, planets follow the first circular harmonic) and planet
    (central bodies stand still, N ≥ 4). A mode gets the family of the subspace that holds most of its kinetic
    energy; modes of equal frequency are first rotated among themselves to the subspaces.

    Parameters
    ----------
    planets : int
    system : LinearSystem
    frequency_hz : ndarray, (n_modes,)
    shapes : ndarray, (n, n_modes)
        Mass-normalised.

    Returns
    -------
    families : tuple of str
    shapes : ndarray, (n, n_modes)
    """
    projectors = _family_projectors(planets, system.dofs)
    shapes = _rotate_equal(frequency_hz, shapes, system.mass, projectors)
    families = []
    for r, f in enumerate(frequency_hz):
        energy = {name: _energy(shapes[:, r], system.mass, p) for name, p in projectors.items()}
        families.append("rigid body" if f == 0.0 else max(energy, key=lambda name: energy[name]))
    return tuple(families), shapes


def _energy(shape: NDArray[np.float64], mass: NDArray[np.float64], projector: NDArray[np.float64]) -> float:
    part = projector @ shape
    return float(part @ mass @ part)


def _rotate_equal(
    frequency_hz: NDArray[np.float64],
    shapes: NDArray[np.float64],
    mass: NDArray[np.float64],
    projectors: Mapping[str, NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Rotate the shapes of equal frequencies (to 1e-9) so that each lies in one family's subspace."""
    shapes = shapes.copy()
    scale = max(float(np.max(frequency_hz, initial=0.0)), 1e-300)
    start = 0
    while start < len(frequency_hz):
        stop = start + 1
        while stop < len(frequency_hz) and frequency_hz[stop] - frequency_hz[start] <= 1e-9 * scale:
            stop += 1
        if stop - start > 1:
            group = shapes[:, start:stop]
            # Different weights part the three subspaces in one symmetric eigenproblem.
            weighted = sum(
                ((i + 1) * p.T @ mass @ p for i, p in enumerate(projectors.values())), np.zeros_like(mass)
            )
            _, turn = np.linalg.eigh(group.T @ weighted @ group)
            shapes[:, start:stop] = group @ turn
        start = stop
    return shapes


def _family_projectors(planets: int, dofs: tuple[str, ...]) -> dict[str, NDArray[np.float64]]:
    """Orthogonal projectors (n, n) on the three subspaces; they add up to the identity."""
    n = len(dofs)
    rotational, translational = np.zeros((n, n)), np.zeros((n, n))
    angles = np.array([planet_angle(k, planets) for k in range(1, planets + 1)])
    uniform = np.full((planets, planets), 1.0 / planets)
    harmonic = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    first = harmonic @ np.linalg.pinv(harmonic, rcond=1e-9)
    for i, dof in enumerate(dofs):
        body, _, axis = dof.rpartition(".")
        if not re.fullmatch(r"planet\d+", body):
            (rotational if axis == "u" else translational)[i, i] = 1.0
    for axis in ("zeta", "eta", "u"):
        at = [dofs.index(f"planet{k}.{axis}") for k in range(1, planets + 1)]
        rotational[np.ix_(at, at)] = uniform
        translational[np.ix_(at, at)] = first
    return {
        "rotational": rotational,
        "translational": translational,
        "planet": np.eye(n) - rotational - translational,
    }


def _make(geometry: Mapping[str, int], parameters: Mapping[str, Parameter]) -> ParametricRig:
    return planetary(geometry["planets"], parameters)


def _extra(name: str, geometry: Mapping[str, int]) -> Parameter | None:
    return extra_parameter(name, geometry["planets"])


def _defaults(geometry: Mapping[str, int]) -> dict[str, Parameter]:
    return default_parameters()


RIG = RigKind(
    name="planetary",
    title="planetary gear: carrier, ring, sun and N planets in the plane (no_ring, with_ring)",
    make=_make,
    geometry={"planets": 2},
    parameters=_defaults,
    extra=_extra,
    drawing=gear_set.in_plane,
)
