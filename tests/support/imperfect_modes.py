"""Measured modes of rigs as laboratories have them: parts, sensors, directions and damping scatter.

Shares nothing with the engine that is tested: matrices are summed here from the elements of an assembly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Spring, difference
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter, Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lab:
    """1 σ of everything that is not as drawn; relative, damping as ln ζ, shapes of the largest entry."""

    parts: float = 0.03
    masses: float = 0.005
    gains: float = 0.04
    transverse: float = 0.05
    damping: float = 0.5
    frequency: float = 1e-3
    shapes: float = 0.02
    damping_ratio: float = 0.01


GOOD = Lab(0.01, 0.003, 0.015, 0.02, 0.2, 3e-4, 0.01)
NORMAL = Lab()
EXACT = Lab(0, 0, 0, 0, 0, 1e-6, 1e-5)


@dataclass(frozen=True)
class Hidden:
    """What is done to a rig: factors on elements by name, and elements added."""

    factors: Mapping[str, float] = dataclasses.field(default_factory=dict)
    added: tuple[Element, ...] = ()


def matrices(elements: Sequence[Element], dofs: Sequence[str], factor: Callable[[Element], float]) -> Array:
    """M, C, K as sums of value·v·vᵀ, (3, n, n)."""
    total = np.zeros((3, len(dofs), len(dofs)))
    for e in elements:
        v = np.array([e.row.get(d, 0.0) for d in dofs])  # type: ignore[union-attr]
        if isinstance(e, Mass):
            total[0] += factor(e) * e.value * np.outer(v, v)
        elif isinstance(e, Damper):
            total[1] += factor(e) * e.coefficient * np.outer(v, v)
        elif isinstance(e, Spring):
            total[2] += factor(e) * e.stiffness * np.outer(v, v)
    return total


def measure(
    rig: Rig,
    sensors: Mapping[str, Sequence[str]],
    band: tuple[float, float],
    seed: int,
    lab: Lab = NORMAL,
    hidden: Hidden | None = None,
) -> dict[str, MeasuredModes]:
    """Modes of every configuration that `sensors` names, of one and the same hardware."""
    rng = np.random.default_rng(seed)
    hidden = hidden or Hidden()
    deviation: dict[tuple[type, str], float] = {}
    gain: dict[str, float] = {}
    cross: dict[str, float] = {}

    def factor(e: Element) -> float:
        key = type(e), getattr(e, "part", "") or e.name
        if key not in deviation:
            deviation[key] = (lab.masses if isinstance(e, Mass) else lab.parts) * rng.normal()
        return float(np.exp(deviation[key])) * hidden.factors.get(e.name, 1.0)

    found = {}
    for configuration, names in sensors.items():
        assembly = rig.assembly(configuration)
        added = [e for e in hidden.added if set(e.row) <= set(assembly.dofs)]  # type: ignore[union-attr]
        m, c, k = matrices(assembly.elements, assembly.dofs, factor)
        more = matrices(added, assembly.dofs, lambda e: 1.0)
        m, c, k = m + more[0], c + more[1], k + more[2]
        values, phi = scipy.linalg.eigh(k, m)
        f = np.sqrt(np.maximum(values, 0)) / (2 * np.pi)
        on = (f > band[0]) & (f < band[1])
        zeta = np.full(len(f), lab.damping_ratio)
        zeta[on] *= np.exp(lab.damping * rng.normal(size=int(on.sum())))
        if np.any(c):
            f, zeta, phi = _damped(m, c + m @ (phi * (4 * np.pi * f * zeta)) @ phi.T @ m, k, phi)
        f, zeta, phi = f[on], zeta[on], phi[:, on]
        rows = []
        for name in names:
            if name not in gain:
                gain[name], cross[name] = np.exp(lab.gains * rng.normal()), lab.transverse * rng.normal()
            rows.append(gain[name] * (_row(assembly, name) + cross[name] * _across(assembly, name)))
        shapes = (np.array(rows) @ phi).T
        # The sign of an eigenvector is the library's choice: noise is to fall on the same shape on every machine.
        shapes = shapes / np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=1)[:, None], axis=1)
        noise = rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape)
        found[configuration] = MeasuredModes(
            configuration=configuration,
            frequency_hz=f * np.exp(lab.frequency * rng.normal(size=len(f))),
            frequency_std_hz=0.5 * lab.frequency * f,
            damping_ratio=zeta * np.exp(0.02 * rng.normal(size=len(f))),
            damping_std=0.02 * zeta,
            shapes=shapes + lab.shapes * noise,
            shape_std=np.full(shapes.shape, lab.shapes),
            dofs=tuple(Dof.parse(n) for n in names),
            band_hz=band,
        )
    return found


def _damped(m: Array, c: Array, k: Array, phi: Array) -> tuple[Array, Array, NDArray[np.complex128]]:
    """Natural frequencies, damping ratios and shapes from the first-order equations, in the order of undamped shapes.

    Each in the phase of the undamped one that it is most like.
    """
    n = len(m)
    first = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(m, k), -np.linalg.solve(m, c)]])
    poles, vectors = scipy.linalg.eig(first)
    up = np.argsort(np.where(poles.imag > 0, np.abs(poles), np.inf))[:n]
    poles, shares = poles[up], phi.T @ m @ vectors[:n, up]
    mode, column = scipy.optimize.linear_sum_assignment(-np.abs(shares) / np.linalg.norm(shares, axis=0))
    poles, shares = poles[column], shares[:, column]
    return np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles), phi @ (shares / shares[mode, mode])


def _row(assembly: Assembly, name: str) -> Array:
    row = assembly.row(name)
    return np.array([row.get(d, 0.0) for d in assembly.dofs])


def _across(assembly: Assembly, name: str) -> Array:
    body, _, direction = name.rpartition(".")
    other = {"x": "y", "y": "x"}.get(direction)
    if other is None or not assembly.has_dof(f"{body}.{other}"):
        return np.zeros(len(assembly.dofs))
    return _row(assembly, f"{body}.{other}")


# --- a rig of the user's own -------------------------------------------------------------------------------------


def chain(masses: int = 5, tolerance: float = 0.03, free: bool = False, held: bool = True) -> ParametricRig:
    """Equal masses between equal springs, both ends held or none; one parameter for all masses, one for all springs."""
    parameters = {
        p.name: p
        for p in (
            Parameter("mass", 2.0, "kg", 0.01),
            Parameter("stiffness", 4e5, "N/m", 0.0 if free else tolerance, 4e4, 4e6, free=free),
            Parameter("modal_damping_ratio", 0.01, "1", 0.3, 0.0, 0.5),
        )
    }
    return ParametricRig("chain", ("all",), parameters, partial(_chain, masses, held))


def _chain(masses: int, held: bool, configuration: str, values: Mapping[str, float]) -> Assembly:
    dofs = [f"m{i + 1}.z" for i in range(masses)]
    elements: list[Element] = [Mass(f"mass {i + 1}", {d: 1.0}, values["mass"]) for i, d in enumerate(dofs)]
    rows = [difference({a: 1.0}, {b: 1.0}) for a, b in zip(dofs[1:], dofs[:-1], strict=True)]
    if held:
        rows = [{dofs[0]: 1.0}, *rows, {dofs[-1]: 1.0}]
    elements += [Spring(f"spring {i}", row, values["stiffness"]) for i, row in enumerate(rows)]
    return Assembly(tuple(dofs), tuple(elements), {}, values["modal_damping_ratio"])


def chain_modes(
    seed: int, lab: Lab = NORMAL, hidden: Hidden | None = None, masses: int = 5, held: bool = True
) -> dict[str, MeasuredModes]:
    """Modes of the chain, every mass with a sensor."""
    names = [f"m{i + 1}.z" for i in range(masses)]
    return measure(chain(masses, held=held), {"all": names}, (10.0, 500.0), seed, lab, hidden)


PLANETARY_BODIES = {
    "no_ring": ("carrier", "sun", "planet1", "planet2"),
    "with_ring": ("carrier", "ring", "sun", "planet1", "planet2"),
}


def planetary_modes(
    rig: Rig,
    seed: int,
    lab: Lab = NORMAL,
    hidden: Hidden | None = None,
    configurations: Sequence[str] = ("no_ring", "with_ring"),
) -> dict[str, MeasuredModes]:
    """Modes of the planetary rig, every body measured in all directions."""
    sensors = {c: [f"{b}.{d}" for b in PLANETARY_BODIES[c] for d in ("x", "y", "u")] for c in configurations}
    return measure(rig, sensors, (5.0, 2500.0), seed, lab, hidden)
