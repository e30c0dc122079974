"""Places and usual sizes of the generic effects: a DOF, a body (all its directions alike), or between two of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np

from ema_pipeline.mechanics.assembly import Assembly, Mass, Row, difference
from ema_pipeline.mechanics.laws import PolynomialSpring

SUSPENDING = 0.05
"""Stiffness of a spring to ground over the median of those between bodies below which it only carries the structure."""

_PARALLEL = 1 - 1e-6
"""Squared cosine of two rows that are one and the same motion."""
_PLANE = ({"x", "y"}, {"zeta", "eta"})


def bodies_and_lone_dofs(assembly: Assembly) -> tuple[str, ...]:
    """Bodies, then single DOFs but for those of a plane: a mass on a body moves with it in both of its directions."""
    lone = []
    for dof in assembly.dofs:
        body, _, direction = dof.rpartition(".")
        own = {d.rpartition(".")[2] for d in assembly.coordinates(body)}
        if not any(direction in plane and plane <= own for plane in _PLANE):
            lone.append(dof)
    return (*assembly.bodies, *lone)


def bodies_pairs_and_dofs(assembly: Assembly) -> tuple[str, ...]:
    """Bodies, pairs of bodies that share a direction, then single DOFs and pairs of DOFs of one direction."""
    return _with_pairs(assembly, combinations(assembly.bodies, 2))


def bodies_joints_and_dofs(assembly: Assembly) -> tuple[str, ...]:
    """The same with those pairs alone that a spring joins: only what touches rubs."""
    joined = {frozenset(dof.rpartition(".")[0] for dof in s.row) for s in assembly.springs()}
    return _with_pairs(
        assembly, (pair for pair in combinations(assembly.bodies, 2) if frozenset(pair) in joined)
    )


def _with_pairs(assembly: Assembly, chosen: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    bodies = [(a, b, _shared(assembly, a, b)) for a, b in chosen]
    pairs = [f"{a}-{b}" for a, b, shared in bodies if shared]
    lone = [f"{a}.{d}-{b}.{d}" for a, b, shared in bodies if len(shared) > 1 for d in shared]
    return (*assembly.bodies, *pairs, *assembly.dofs, *lone)


def is_place(assembly: Assembly, place: str) -> bool:
    """True for a sensor's DOF, or two bodies or DOFs of the assembly joined by ``-``."""
    return assembly.has_dof(place) or _split(assembly, place) is not None


def place_rows(assembly: Assembly, place: str) -> tuple[Row, ...]:
    """Rows of the motions at a place: of a DOF, of all directions of a body, or of what lies between two."""
    if assembly.has_dof(place):
        return (assembly.row(place),)
    if place in assembly.bodies:
        return tuple(assembly.row(d) for d in _directions(assembly, place))
    pair = _split(assembly, place)
    if pair is None:
        return (assembly.row(place),)  # raises with a hint
    a, b = pair
    if assembly.has_dof(a):
        return (difference(assembly.row(a), assembly.row(b)),)
    return tuple(
        difference(assembly.row(f"{a}.{d}"), assembly.row(f"{b}.{d}")) for d in _shared(assembly, a, b)
    )


def with_polynomial_springs(assembly: Assembly, place: str, title: str, **term: float) -> Assembly:
    """The assembly with a nonlinear spring along every motion at a place; `term` is one of the law's coefficients."""
    if not any(term.values()):
        return assembly
    rows = place_rows(assembly, place)
    return assembly.add(*(PolynomialSpring(f"{title} {i} at {place}", r, **term) for i, r in enumerate(rows)))


def usual_stiffness(assembly: Assembly) -> float:
    """Half of the median stiffness of the model's springs, N/m; foam or cords that carry it do not count."""
    springs = [s for s in assembly.springs() if s.stiffness > 0]
    inner = [s.stiffness for s in springs if not _to_ground(s.row)]
    least = SUSPENDING * float(np.median(inner)) if inner else 0.0
    known = [s.stiffness for s in springs if not _to_ground(s.row) or s.stiffness > least]
    return 0.5 * float(np.median(known)) if known else 1e5


def _to_ground(row: Row) -> bool:
    return len({dof.rpartition(".")[0] for dof in row}) == 1


def least_stiffness(assembly: Assembly, place: str) -> Mapping[str, float]:
    """Smallest size of an added spring, N/m: what stands there can be lost, and no more."""
    springs = [(s.row, s.stiffness) for s in assembly.springs()]
    return {"stiffness": 0.0 - _least_along(assembly, place, springs)}


def least_mass(assembly: Assembly, place: str) -> Mapping[str, float]:
    """Smallest size of an added mass, kg: what moves there can be lost, and no more."""
    masses = [(e.row, e.value) for e in assembly.elements if isinstance(e, Mass)]
    return {"mass": 0.0 - _least_along(assembly, place, masses)}


def _least_along(assembly: Assembly, place: str, elements: Sequence[tuple[Row, float]]) -> float:
    """Least, over the motions at a place, of the elements' values along that motion and no other."""
    return min((_along(row, elements) for row in place_rows(assembly, place)), default=0.0)


def _along(row: Row, elements: Sequence[tuple[Row, float]]) -> float:
    total = 0.0
    for other, value in elements:
        dofs = [d for d in {**row, **other} if row.get(d) or other.get(d)]
        a, b = (np.array([r.get(d, 0.0) for d in dofs]) for r in (row, other))
        if (a @ b) ** 2 > _PARALLEL * (a @ a) * (b @ b) > 0:
            total += value * float(b @ b) / float(a @ a)
    return total


def usual_mass(assembly: Assembly, place: str) -> float:
    """Three tenths of the mass that moves at a place, kg."""
    moved = [moved_mass(assembly, row) for row in place_rows(assembly, place)]
    return 0.3 * max(float(np.mean(moved)), 1e-6)


def moved_mass(assembly: Assembly, row: Row) -> float:
    """Mass that moves along a row, kg."""
    masses = [e for e in assembly.elements if isinstance(e, Mass)]
    return sum(m.value * (m.row.get(d, 0.0) * v) ** 2 for m in masses for d, v in row.items())


def usual_damping(assembly: Assembly, place: str) -> float:
    """Three tenths of √(k m) of usual stiffness and mass, N·s/m: a good tenth of critical, as dampers are made."""
    return 0.3 * float(np.sqrt(2 * usual_stiffness(assembly) * usual_mass(assembly, place) / 0.3))


def stiffness_scale(assembly: Assembly, place: str) -> Mapping[str, float]:
    """Prior 1 σ of an added spring."""
    return {"stiffness": usual_stiffness(assembly)}


def mass_scale(assembly: Assembly, place: str) -> Mapping[str, float]:
    """Prior 1 σ of an added mass."""
    return {"mass": usual_mass(assembly, place)}


def damping_scale(assembly: Assembly, place: str) -> Mapping[str, float]:
    """Prior 1 σ of an added damper."""
    return {"coefficient": usual_damping(assembly, place)}


def _directions(assembly: Assembly, body: str) -> tuple[str, ...]:
    """Coordinates along which a body is displaced; those about which it turns where it does nothing else."""
    own = assembly.coordinates(body)
    return tuple(d for d in own if not d.endswith(".u")) or own


def _shared(assembly: Assembly, a: str, b: str) -> tuple[str, ...]:
    """Directions that both bodies have, in the fixed frame where they have it."""
    for directions in (("x", "y", "z"), ("u",)):
        shared = tuple(d for d in directions if assembly.has_dof(f"{a}.{d}") and assembly.has_dof(f"{b}.{d}"))
        if shared:
            return shared
    own = [d.rpartition(".")[2] for d in assembly.coordinates(a)]
    return tuple(d for d in own if assembly.has_dof(f"{b}.{d}"))


def _split(assembly: Assembly, place: str) -> tuple[str, str] | None:
    # Names of bodies may hold "-" themselves, so every one is tried.
    for i, character in enumerate(place):
        a, b = place[:i], place[i + 1 :]
        if character != "-" or a == b:
            continue
        if assembly.has_dof(a) and assembly.has_dof(b):
            return a, b
        if a in assembly.bodies and b in assembly.bodies and _shared(assembly, a, b):
            return a, b
    return None
