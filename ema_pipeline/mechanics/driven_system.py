"""A structure with nonlinear elements as arrays that a compiled loop marches under forces, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.dissipation import HystereticSpring, SquareDamper
from ema_pipeline.mechanics.laws import (
    BoucWen,
    DryFriction,
    Maxwell,
    Nonlinear,
    PartingSpring,
    PolynomialSpring,
)
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem

POLYNOMIAL, FRICTION, SQUARE_DAMPER, BOUC_WEN, PARTING, MAXWELL = range(6)
"""Kinds of elements; `mechanics.simulation_kernel` has their laws, and what their four numbers are."""
WITH_MEMORY = (BOUC_WEN, MAXWELL)
"""Kinds that have a memory."""
_NO_LOSS = 1e-6
"""Least σ of a Bouc-Wen law: below it, it is a spring."""


@dataclass(frozen=True)
class DrivenSystem:
    """What the compiled loop marches: accelerations by displacements, velocities, forces and elements.

    Attributes
    ----------
    stiffness, damping : ndarray, (n, n)
        M⁻¹K and M⁻¹C of the linear elements.
    inputs : ndarray, (n, n_inputs)
        M⁻¹ times the rows of the forces.
    push : ndarray, (n, m)
        M⁻¹ times the rows of the nonlinear elements.
    numbers : ndarray, (m, 4)
        Of the elements' laws.
    rows : ndarray, (m, n)
    kinds : ndarray of int, (m,)
    """

    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    inputs: NDArray[np.float64]
    push: NDArray[np.float64]
    numbers: NDArray[np.float64]
    rows: NDArray[np.float64]
    kinds: NDArray[np.int64]

    @property
    def size(self) -> int:
        """Number of states: displacements, velocities, memories."""
        return 2 * len(self.stiffness) + len(self.kinds)

    @property
    def varied(self) -> tuple[NDArray[np.float64], ...]:
        """The arrays that parameters change."""
        return self.stiffness, self.damping, self.inputs, self.push, self.numbers


@dataclass(frozen=True)
class CodedElements:
    """Nonlinear elements as the compiled loop takes them.

    Attributes
    ----------
    rows : ndarray, (m, n)
    tangent : ndarray, (m,)
        Stiffness at rest, which the linear system holds already, N/m.
    numbers : ndarray, (m, 4)
    kinds : ndarray of int, (m,)
    """

    rows: NDArray[np.float64]
    tangent: NDArray[np.float64]
    numbers: NDArray[np.float64]
    kinds: NDArray[np.int64]

    @classmethod
    def of(cls, assembly: Assembly) -> CodedElements:
        """Those of an assembly; EmaError for elements that the loop does not know."""
        elements = assembly.nonlinear
        coded = [coded_law(e) for e in elements]
        return cls(
            np.ascontiguousarray(element_rows(assembly, elements)),
            np.array([e.tangent_stiffness for e in elements]),
            np.array([numbers for _, numbers in coded]).reshape(len(elements), 4),
            np.array([kind for kind, _ in coded], dtype=np.int64),
        )

    def driven(self, system: LinearSystem, in_rows: NDArray[np.float64]) -> DrivenSystem:
        """A linear system with these elements, driven by forces.

        Parameters
        ----------
        system : LinearSystem
            Tangents of the elements included.
        in_rows : ndarray, (n_inputs, n)
            Where the forces act, over the coordinates.

        Raises
        ------
        EmaError
            For structural damping, which has no time response.
        """
        if np.any(system.structural):
            raise EmaError(
                "a loss factor holds at steady state only and has no time response; replace it by a damper"
            )
        n, q = len(system.mass), len(in_rows)
        stiffness = system.stiffness - self.rows.T @ (self.tangent[:, None] * self.rows)
        solved = np.linalg.solve(
            system.mass, np.hstack([stiffness, total_damping(system), in_rows.T, self.rows.T])
        )
        parts = (solved[:, :n], solved[:, n : 2 * n], solved[:, 2 * n : 2 * n + q], solved[:, 2 * n + q :])
        stiffness, damping, inputs, push = (np.ascontiguousarray(p) for p in parts)
        return DrivenSystem(stiffness, damping, inputs, push, self.numbers, self.rows, self.kinds)


def coded_law(element: Nonlinear) -> tuple[int, tuple[float, float, float, float]]:
    """Kind and numbers of an element, see `mechanics.simulation_kernel`; EmaError for one that it does not know."""
    if isinstance(element, PolynomialSpring):
        return POLYNOMIAL, (element.quadratic, element.cubic, 0.0, 0.0)
    if isinstance(element, DryFriction):
        return FRICTION, (element.limit, element.velocity, 0.0, 0.0)
    if isinstance(element, SquareDamper):
        return SQUARE_DAMPER, (element.coefficient, 0.0, 0.0, 0.0)
    if isinstance(element, HystereticSpring):
        return BOUC_WEN, (element.stiffness, element.force, element.shape, element.exponent)
    if isinstance(element, BoucWen):
        sigma = max(element.sigma, _NO_LOSS)
        force = element.limit / sigma ** (1 / element.exponent)
        return BOUC_WEN, (element.tangent_stiffness, force, (1 - sigma) / sigma, element.exponent)
    if isinstance(element, PartingSpring):
        far = 1e6  # m: a contact that never parts
        return PARTING, (element.stiffness, min(element.preload, far), min(element.gap, far), 0.0)
    if isinstance(element, Maxwell):
        return MAXWELL, (element.stiffness, element.time, 0.0, 0.0)
    raise EmaError(f"element '{element.name}' has no law that continuous records can be simulated with")


@dataclass(frozen=True)
class Slopes:
    """Derivatives of a `DrivenSystem` and of the first state by p parameters: arrays with p last."""

    stiffness: NDArray[np.float64]
    damping: NDArray[np.float64]
    inputs: NDArray[np.float64]
    push: NDArray[np.float64]
    numbers: NDArray[np.float64]
    begin: NDArray[np.float64]

    @classmethod
    def none(cls, system: DrivenSystem, count: int) -> Slopes:
        """Zeros to be filled in, of `count` parameters."""
        stiffness, damping, inputs, push, numbers = (np.zeros((*a.shape, count)) for a in system.varied)
        return cls(stiffness, damping, inputs, push, numbers, np.zeros((system.size, count)))

    @property
    def arrays(self) -> tuple[NDArray[np.float64], ...]:
        """All of them, that of the first state last."""
        return self.stiffness, self.damping, self.inputs, self.push, self.numbers, self.begin

    def first(self, count: int) -> Slopes:
        """The derivatives by the first `count` parameters."""
        return Slopes(*(np.ascontiguousarray(a[..., :count]) for a in self.arrays))


def resolved(
    system: DrivenSystem, step: float, slopes: Slopes | None = None
) -> tuple[DrivenSystem, Slopes | None]:
    """The system with friction no sharper than a step, s, resolves, and its derivatives: else it rings."""
    numbers = system.numbers.copy()
    change = None if slopes is None else slopes.numbers.copy()
    for j in np.flatnonzero(system.kinds == FRICTION):
        per_newton = abs(float(system.rows[j] @ system.push[:, j])) * step
        if numbers[j, 1] < per_newton * abs(numbers[j, 0]):
            numbers[j, 1] = per_newton * abs(numbers[j, 0])
            if change is not None:
                change[j, 1] = per_newton * np.sign(numbers[j, 0]) * change[j, 0]
    return replace(system, numbers=numbers), None if slopes is None or change is None else replace(
        slopes, numbers=change
    )
