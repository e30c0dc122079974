"""Force of a rig's isolator along prescribed loops as a function of the rig's unknowns, with its derivatives.

Derivatives by families are exact, because each element's force follows a power of its families' values. Those by
effects' sizes and by the displacement's calibration are differences of the elements that they change.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.isolators import isolator_row, isolators
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Gyroscopic, Mass, Row, Spring
from ema_pipeline.mechanics.cycles import Contact, Cycles
from ema_pipeline.mechanics.laws import LooseSpring
from ema_pipeline.observations.parts import part_key
from ema_pipeline.observations.rig_model import RigModel
from ema_pipeline.rigs.types import Rig

_STEP = 1e-4
"""Step of differences, in units of the unknowns: small beside any prior, large beside rounding."""
_SAME_ROW = 1e-9
"""Relative difference of the entries of two rows that is rounding."""
_STRUCTURAL = (Mass, Gyroscopic)
"""Elements that are no part of the isolator: the displacement is prescribed at both of its ends."""

Stretched = tuple[Element, float]
"""An element, and how much it is stretched by the isolator's stretch."""


@dataclass(frozen=True)
class Isolator:
    """Where a rig's isolator sits.

    Attributes
    ----------
    configuration : str
        The first one that has it.
    place : str
    row : dict of str to float
        Its stretch over the rig's coordinates.
    """

    configuration: str
    place: str
    row: Row

    @classmethod
    def of(cls, rig: Rig) -> Isolator:
        """The first isolator of a rig; EmaError where there is none."""
        for configuration in rig.configurations:
            assembly = rig.assembly(configuration)
            places = isolators(assembly)
            if places:
                return cls(configuration, places[0], isolator_row(assembly, places[0]))
        raise EmaError(f"rig '{rig.name}' has no isolator that loops could be measured on")

    def elements(self, assembly: Assembly) -> list[Stretched]:
        """Elements along the isolator's stretch."""
        found = []
        for e in assembly.elements:
            factor = None if isinstance(e, _STRUCTURAL) else _multiple(e.row, self.row)
            if factor is not None:
                found.append((e, factor))
        return found

    def shows(self, rig: Rig, placed: PlacedEffect) -> bool:
        """True for an effect that changes the elements along the isolator's stretch."""
        assembly = rig.assembly(self.configuration)
        if not placed.effect.fits(assembly, placed.place):
            return False
        values = {p.name: p.start for p in placed.effect.parameters}
        edited = placed.effect.edit(assembly, placed.place, values)
        return self.elements(edited) != self.elements(assembly)


def effects_of_loops(
    rig: Rig, labels: Iterable[str], library: Mapping[str, Effect]
) -> tuple[PlacedEffect, ...]:
    """Effects ``id@place`` that change the force of an isolator's loops.

    Raises
    ------
    EmaError
        For effects and places that the rig has not, and for effects that a force loop does not show.
    """
    isolator, found = Isolator.of(rig), []
    for label in labels:
        placed = parse_effect(label, rig, isolator.configuration, library)
        if not isolator.shows(rig, placed):
            raise EmaError(f"effect '{label}' cannot be judged by force-displacement loops")
        found.append(placed)
    return tuple(found)


class IsolatorForce:
    """Force of an isolator along cycles as a function of the unknowns of a `RigModel`."""

    def __init__(self, isolator: Isolator, model: RigModel, cycles: Cycles) -> None:
        self.isolator, self.model, self.cycles = isolator, model, cycles
        self.exponents = model.dependence.elements[isolator.configuration]

    def elements(self, x: NDArray[np.float64]) -> list[Stretched]:
        """Elements along the isolator's stretch at the model's unknowns `x`."""
        logs = x[: len(self.model.dependence.unknowns)]
        assembly = self.model.assembly(self.isolator.configuration, x[self.model.edit_start :])
        return [
            (_times(e, self.exponents.get(part_key(e)), logs), factor)
            for e, factor in self.isolator.elements(assembly)
        ]

    def at(self, x: NDArray[np.float64], log_reading: float) -> ForceAtPoint:
        """The force at unknowns `x`, the displacement reading exp(`log_reading`) times what it is."""
        return ForceAtPoint(self, x, log_reading)


class ForceAtPoint:
    """Force of an isolator at one point of its unknowns, and how it changes nearby.

    Attributes
    ----------
    total : ndarray, (n_points,)
        N.
    """

    def __init__(self, force: IsolatorForce, x: NDArray[np.float64], log_reading: float) -> None:
        self._force, self._x, self._log_reading = force, x, log_reading
        self._elements = force.elements(x)
        self._path = _path(force.cycles.scaled(float(np.exp(-log_reading))), self._elements)
        self._columns = [_of_one(self._path, *e) for e in self._elements]
        self.total = self._summed(self._columns)

    def slopes(self) -> NDArray[np.float64]:
        """Derivatives of the force by the model's unknowns, (n_points, n)."""
        model = self._force.model
        slopes = np.zeros((len(self.total), len(self._x)))
        for (element, _), column in zip(self._elements, self._columns, strict=True):
            row = self._force.exponents.get(part_key(element))
            if row is not None:
                slopes[:, : len(row)] += np.outer(column, row)
        for i in range(model.edit_start, len(self._x)):
            slopes[:, i] = self._difference(i)
        return slopes

    def slope_by_reading(self) -> NDArray[np.float64]:
        """Derivative of the force by the logarithm of the displacement's reading, (n_points,)."""
        path = _path(self._force.cycles.scaled(float(np.exp(-self._log_reading - _STEP))), self._elements)
        return (self._summed([_of_one(path, *e) for e in self._elements]) - self.total) / _STEP

    def _difference(self, i: int) -> NDArray[np.float64]:
        """Derivative by one unknown, over a small step within its bounds; only elements that change are run."""
        step = _STEP if self._x[i] + _STEP <= self._force.model.unknowns.upper[i] else -_STEP
        moved = self._x.copy()
        moved[i] += step
        elements, path = self._force.elements(moved), self._path
        known = list(zip(self._elements, self._columns, strict=True))
        if _play(elements) != _play(self._elements):
            path, known = _path(self._force.cycles.scaled(float(np.exp(-self._log_reading))), elements), []
        columns = []
        for one in elements:
            before = next((column for other, column in known if other == one), None)
            columns.append(_of_one(path, *one) if before is None else before)
        return (self._summed(columns) - self.total) / step

    def _summed(self, columns: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.asarray(sum(columns, np.zeros(len(self._force.cycles.x))))


def _path(cycles: Cycles, elements: Sequence[Stretched]) -> Cycles | Contact:
    """What the elements see of the motion; the play that they share is along the isolator's own stretch."""
    return cycles.met_by([e for e, _ in elements])


def _play(elements: Sequence[Stretched]) -> float:
    return next((e.gap for e, _ in elements if isinstance(e, LooseSpring)), 0.0)


def _of_one(path: Cycles | Contact, element: Element, factor: float) -> NDArray[np.float64]:
    """Force along the isolator by an element that is stretched `factor` times as much."""
    if factor == 1.0:
        return path.force_of(element)
    return factor * path.scaled(factor).force_of(element)


def _multiple(row: Row, of: Row) -> float | None:
    """Factor by which a row is a multiple of another; None where it is none."""
    mine = {k: v for k, v in row.items() if v}
    theirs = {k: v for k, v in of.items() if v}
    if mine.keys() != theirs.keys() or not mine:
        return None
    factors = [mine[k] / theirs[k] for k in mine]
    alike = all(abs(f - factors[0]) <= _SAME_ROW * abs(factors[0]) for f in factors)
    return factors[0] if alike else None


def _times(element: Element, row: NDArray[np.float64] | None, logs: NDArray[np.float64]) -> Element:
    """An element with its value as its families have it."""
    if row is None:
        return element
    factor = float(np.exp(row @ logs))
    if isinstance(element, Spring):
        return dataclasses.replace(element, stiffness=element.stiffness * factor)
    if isinstance(element, Damper):
        return dataclasses.replace(element, coefficient=element.coefficient * factor)
    return element
