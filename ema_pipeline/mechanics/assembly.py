"""Named elements (masses, springs, dampers) and the linear system that they make up.

An element acts along a *row*: the coefficients v of its stretch δ = v·x over named DOFs. A spring stores
½kδ², so it adds k·v·vᵀ to K; masses and dampers add to M and C in the same way. Assembling from rows keeps
every matrix symmetric by construction and leaves no blocks to mistype.

Effects are edits of this list: take an element by its name, change it, add another one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.laws import Nonlinear, Row, Spring
from ema_pipeline.mechanics.system import LinearSystem

__all__ = [
    "Assembly",
    "Damper",
    "Element",
    "Gyroscopic",
    "Mass",
    "Nonlinear",
    "Row",
    "Spring",
    "combination",
    "difference",
    "row_matrix",
]


@dataclass(frozen=True)
class Mass:
    """Kinetic energy ½·value·(row·ẋ)²; kg, or I/r² for a coordinate u = r·θ.

    Elements of one `part` are one piece of hardware and deviate from the drawing together; an element without one
    is a part of its own.
    """

    name: str
    row: Row
    value: float
    part: str = ""


@dataclass(frozen=True)
class Damper:
    """Viscous force coefficient·(row·ẋ) along the row; N·s/m."""

    name: str
    row: Row
    coefficient: float
    part: str = ""


@dataclass(frozen=True)
class Gyroscopic:
    """Skew coupling, lossless: force coefficient·(b·ẋ) along row a, -coefficient·(a·ẋ) along row b; N·s/m."""

    name: str
    a: Row
    b: Row
    coefficient: float


Element = Mass | Spring | Damper | Gyroscopic | Nonlinear


@dataclass(frozen=True)
class Assembly:
    """Coordinates, elements and derived sensor places; `system()` makes matrices of them.

    Attributes
    ----------
    dofs : tuple of str
        Coordinates, ``"body.direction"``.
    elements : tuple
        Elements with names that are unique.
    sensors : dict of str to row
        Sensor places that are no coordinates, e.g. ``"planet2.x"``.
    modal_damping_ratio : float
        Damping ratio of every mode on top of dampers and loss factors.
    """

    dofs: tuple[str, ...]
    elements: tuple[Element, ...]
    sensors: Mapping[str, Row] = field(default_factory=dict)
    modal_damping_ratio: float = 0.0

    @property
    def bodies(self) -> tuple[str, ...]:
        """Bodies in the order of their first coordinate."""
        return tuple(dict.fromkeys(d.rpartition(".")[0] for d in self.dofs))

    def has_dof(self, dof: str) -> bool:
        """True for a coordinate or a derived sensor place."""
        return dof in self.dofs or dof in self.sensors

    def row(self, dof: str) -> Row:
        """Row of a coordinate or of a derived sensor place; EmaError for others."""
        if dof in self.dofs:
            return {dof: 1.0}
        if dof in self.sensors:
            return self.sensors[dof]
        raise EmaError(f"the model has no dof '{dof}'{did_you_mean(dof, (*self.dofs, *self.sensors))}")

    def coordinates(self, body: str) -> tuple[str, ...]:
        """Coordinates of one body."""
        return tuple(d for d in self.dofs if d.rpartition(".")[0] == body)

    def named(self, name: str) -> Element:
        """The element of that name; EmaError if there is none."""
        for element in self.elements:
            if element.name == name:
                return element
        raise EmaError(
            f"the model has no element '{name}'{did_you_mean(name, [e.name for e in self.elements])}"
        )

    def springs(self, *, suffix: str = "", prefix: str = "") -> tuple[Spring, ...]:
        """Springs whose names start and end so."""
        return tuple(
            e
            for e in self.elements
            if isinstance(e, Spring) and e.name.endswith(suffix) and e.name.startswith(prefix)
        )

    def add(self, *elements: Element, dofs: Sequence[str] = ()) -> Assembly:
        """A copy with further elements, and further coordinates for them."""
        return dataclasses.replace(self, dofs=(*self.dofs, *dofs), elements=(*self.elements, *elements))

    def edit(self, names: Iterable[str], change: Callable[[Element], Element | None]) -> Assembly:
        """A copy in which `change` replaces the named elements; ``None`` takes an element out."""
        wanted = set(names)
        missing = wanted.difference(e.name for e in self.elements)
        for name in missing:
            self.named(name)  # raises with a hint
        edited = (change(e) if e.name in wanted else e for e in self.elements)
        return dataclasses.replace(self, elements=tuple(e for e in edited if e is not None))

    @property
    def nonlinear(self) -> tuple[Nonlinear, ...]:
        """Elements whose force is not proportional to the motion."""
        return tuple(e for e in self.elements if isinstance(e, Nonlinear))

    def system(self) -> LinearSystem:
        """Matrices of all elements; nonlinear ones with their tangents.

        Raises
        ------
        EmaError
            If a row names a DOF that is no coordinate.
        """
        index = {d: i for i, d in enumerate(self.dofs)}
        masses = [e for e in self.elements if isinstance(e, Mass)]
        springs = [e for e in self.elements if isinstance(e, Spring)]
        dampers = [e for e in self.elements if isinstance(e, Damper)]
        for n in self.nonlinear:
            if not isinstance(n, Spring):
                springs.append(Spring(n.name, n.row, n.tangent_stiffness))
                dampers.append(Damper(n.name, n.row, n.tangent_damping))
        mass = _sum_of_squares([e.row for e in masses], [e.value for e in masses], index)
        stiffness = _sum_of_squares([e.row for e in springs], [e.stiffness for e in springs], index)
        lossy = [e for e in springs if e.loss_factor != 0.0]
        structural = _sum_of_squares(
            [e.row for e in lossy], [e.stiffness * e.loss_factor for e in lossy], index
        )
        damping = _sum_of_squares([e.row for e in dampers], [e.coefficient for e in dampers], index)
        for e in self.elements:
            if isinstance(e, Gyroscopic):
                a, b = row_matrix([e.a, e.b], index)
                damping += e.coefficient * (np.outer(a, b) - np.outer(b, a))
        places = list(self.sensors)
        sensors = dict(zip(places, row_matrix([self.sensors[p] for p in places], index), strict=True))
        return LinearSystem(
            dofs=self.dofs,
            mass=mass,
            stiffness=stiffness,
            damping=damping,
            structural=structural,
            modal_damping_ratio=float(self.modal_damping_ratio),
            sensors=sensors,
        )


def difference(a: Row, b: Row) -> Row:
    """Row of the stretch between two places, a - b."""
    return {d: a.get(d, 0.0) - b.get(d, 0.0) for d in dict.fromkeys((*a, *b))}


def combination(*terms: tuple[float, Row]) -> Row:
    """Row of a weighted sum of rows."""
    total: dict[str, float] = {}
    for weight, row in terms:
        for dof, value in row.items():
            total[dof] = total.get(dof, 0.0) + weight * value
    return total


def row_matrix(rows: Sequence[Row], index: Mapping[str, int]) -> NDArray[np.float64]:
    """Rows over the coordinates, whose positions `index` tells, (m, n)."""
    matrix = np.zeros((len(rows), len(index)))
    for i, row in enumerate(rows):
        for dof, value in row.items():
            if dof not in index:
                raise EmaError(f"an element acts on the unknown dof '{dof}'{did_you_mean(dof, index)}")
            matrix[i, index[dof]] = value
    return matrix


def _sum_of_squares(
    rows: Sequence[Row], weights: Sequence[float], index: Mapping[str, int]
) -> NDArray[np.float64]:
    """Σ w·v·vᵀ, (n, n)."""
    v = row_matrix(rows, index)
    return np.asarray(v.T @ (np.asarray(weights, dtype=float)[:, None] * v))
