"""Models whose lowest modes are lost to rounding, and the element to blame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg

from ema_pipeline.mechanics.assembly import Assembly, Gyroscopic, Mass, Nonlinear, Row, Spring, row_matrix
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.mechanics.system import LinearSystem

SPAN = 1e12
"""Largest over smallest ω² that a model may have. The eigenvalues' rounding is some 1e-16 of the largest, so that
beyond this the lowest frequencies err by more than a measurement does, and from 1e14 on they are gone."""

LOWEST_HZ = 0.01
"""No test shows a mode below: it is the rigid body on its suspension, and its frequency need not be right."""

Weighted = tuple[str, Row, float]


def lost_to_rounding(assembly: Assembly) -> Mass | Spring | Nonlinear | Gyroscopic | None:
    """The element beside which a mode that is no rigid-body mode is too low to be computed; None where all are.

    Raises
    ------
    EmaError
        As `eigen_solution`.
    """
    system = assembly.system()
    if (coupling := _too_strong(assembly, system)) is not None:
        return coupling
    if _all_far_from_zero(system):
        return None
    values, shapes = eigen_solution(system)
    least = values[-1] / SPAN
    springs = [(e.name, e.row, _stiffness(e)) for e in assembly.elements if isinstance(e, Spring | Nonlinear)]
    springs = [s for s in springs if s[2] != 0.0]
    if any(k < 0 for _, _, k in springs):  # springs may cancel, so that what is rigid cannot be counted
        rigid = int(np.sum(values == 0.0))
    else:
        rigid = _rigid_body_modes([row for _, row, _ in springs], assembly.dofs)
    if rigid == len(values) or values[rigid] > least:
        return None
    # Summed spring by spring, energies keep what the matrix has lost.
    low = [dict(zip(assembly.dofs, s, strict=True)) for s in shapes[:, values <= least].T]
    if all(sum(_energies(springs, shape)) < (2 * np.pi * LOWEST_HZ) ** 2 for shape in low):
        return None
    highest = dict(zip(assembly.dofs, shapes[:, -1], strict=True))
    masses = [(e.name, e.row, e.value) for e in assembly.elements if isinstance(e, Mass)]
    (spring, far), (mass, near) = _unlike(springs, highest), _unlike(masses, highest)
    found = assembly.named(spring if far >= near else mass)
    assert isinstance(found, Mass | Spring | Nonlinear)
    return found


def _too_strong(assembly: Assembly, system: LinearSystem) -> Gyroscopic | None:
    """The gyroscopic coupling, of either sign, whose own frequency squared is further above all others than `SPAN`.

    A coupling splits two modes at ω into one near its own frequency ω_g and one near ω²/ω_g.
    """
    couplings = [e for e in assembly.elements if isinstance(e, Gyroscopic)]
    if not couplings:
        return None
    index = {d: i for i, d in enumerate(assembly.dofs)}
    highest = float(eigen_solution(system)[0][-1])
    for e in couplings:
        a, b = row_matrix([e.a, e.b], index)
        inertias = [float(v @ np.linalg.solve(system.mass, v)) for v in (a, b)]
        if highest > 0 and e.coefficient**2 * inertias[0] * inertias[1] > SPAN * highest:
            return e
    return None


def _all_far_from_zero(system: LinearSystem) -> bool:
    """True where the eigenvalues alone, a third of the work of a solution with shapes, show that nothing is wrong."""
    try:
        values = scipy.linalg.eigvalsh(system.stiffness, system.mass, check_finite=False)
    except (np.linalg.LinAlgError, ValueError):
        return False
    return bool(values[0] > values[-1] / SPAN)


def said_of_lost(element: Mass | Spring | Nonlinear | Gyroscopic) -> str:
    """What is wrong with the element that `lost_to_rounding` found, and what to do."""
    if isinstance(element, Mass):
        what, remedy = f"{element.value:g} is so small", "give a larger mass, or leave the coordinate out"
    elif isinstance(element, Gyroscopic):
        what = f"{element.coefficient:g} is so large"
        remedy = "give a coupling nearer to 0"
    else:
        what = f"{_stiffness(element):g} is so large"
        remedy = "give a smaller stiffness, or make one body of the two"
    return f"'{element.name}' = {what} that the model's lowest modes are lost to rounding; {remedy}"


def _stiffness(element: Spring | Nonlinear) -> float:
    return element.stiffness if isinstance(element, Spring) else element.tangent_stiffness


def _rigid_body_modes(rows: Sequence[Row], dofs: Sequence[str]) -> int:
    """Number of motions that stretch no spring, whatever its stiffness."""
    unit = row_matrix(rows, {d: i for i, d in enumerate(dofs)})
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-300)
    values = np.linalg.eigvalsh(unit.T @ unit)
    return int(np.sum(values <= 64 * len(dofs) * np.finfo(float).eps * max(float(values[-1]), 1e-300)))


def _unlike(elements: Sequence[Weighted], shape: Mapping[str, float]) -> tuple[str, float]:
    """The element with most energy in a mode, and how many decades it is from what is usual of its kind."""
    decades = np.log10([abs(weight) for *_, weight in elements])
    most = int(np.argmax(np.abs(_energies(elements, shape))))
    return elements[most][0], float(abs(decades[most] - np.median(decades)))


def _energies(elements: Sequence[Weighted], shape: Mapping[str, float]) -> list[float]:
    """Twice the energy of each element in a mode."""
    return [weight * sum(c * shape[d] for d, c in row.items()) ** 2 for _, row, weight in elements]
