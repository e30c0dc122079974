"""How every element of a rig depends on the values that like parts share, and on what its own part deviates.

A *family* is a parameter of the rig: the value that all like parts share, known to its tolerance. A *part* is one
piece of hardware: an element, or several that say that they are one. Both are unknown logarithms, so that no trial
value of a mass or a stiffness is ever negative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import Unknowns, joined
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Row, Spring
from ema_pipeline.rigs.types import Parameter, Rig

DAMPING_SCATTER = "damping_scatter"
JOINT_DAMPING = "joint_damping"
PART_SCATTER = "part_scatter"
MASS_SCATTER = "mass_scatter"
DIRECTION_SCATTER = "direction_scatter"
STIFFNESS_STD = 0.02
"""1 σ of stiffnesses from part to part where a rig states none, relative; their scatter is learned in its units."""
MASS_STD = 0.005
DAMPER_STD = 0.3
DIRECTION_STD = 0.01
"""The same of the directions of one piece of hardware about what it deviates itself: a rolling bearing that is softer
than others is so in all directions. Learned apart: that directions agree does not tell that pieces do."""

FREE_STD = (0.5, 2.5)
"""Least and largest prior 1 σ of the logarithm of a free parameter."""
_UNBOUNDED_STD = 1.5
DAMPING = "modal_damping_ratio"
DAMPING_POWER = "damping_power"

PartKey = tuple[type, str]
"""Kind of element and name of its part."""


@dataclass(frozen=True)
class Dependence:
    """Derivatives of the logarithms of all elements' values by the unknown logarithms.

    Attributes
    ----------
    unknowns : Unknowns
        Families first, then parts.
    elements : dict of str to dict of key to ndarray, (n,)
        By configuration and by part of an element.
    families : tuple of str
        Parameters among the unknowns.
    geometric : tuple of str
        Uncertain parameters that no element's value is a power of: with them the elements are built anew.
    joints : ndarray of int, (j,)
        Positions of the unknowns of springs without a damper beside them: what such a part loses is not in the rig.
    known : dict
        What models of the rig have found of their effects, for others with the same ones.
    """

    unknowns: Unknowns
    elements: Mapping[str, Mapping[PartKey, NDArray[np.float64]]]
    families: tuple[str, ...]
    geometric: tuple[str, ...]
    joints: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    known: dict[object, Any] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def sole_parts(self) -> dict[str, tuple[str, float]]:
        """The only part of a family, and what the family's logarithm changes per logarithm of the part, by family.

        What such a part deviates is its family's: the value that a reader looks for is that of the part.
        """
        count, found = len(self.families), {}
        rows = [row for elements in self.elements.values() for row in elements.values()]
        for i, family in enumerate(self.families):
            own = {tuple(row) for row in rows if row[i]}
            row = np.array(own.pop()) if len(own) == 1 else np.zeros(0)
            parts = count + np.flatnonzero(row[count:])
            if len(parts) == 1 and np.count_nonzero(row[:count]) == 1:
                found[family] = (self.unknowns.names[parts[0]], float(row[parts[0]] / row[i]))
        return found


def part_key(element: Element) -> PartKey:
    """What identifies the part that an element belongs to."""
    kind = next((k for k in (Mass, Spring, Damper) if isinstance(element, k)), type(element))
    return kind, getattr(element, "part", "") or element.name


def value_of(element: Element) -> float:
    """Mass, stiffness or damping coefficient of an element; 0 for elements of another kind."""
    if isinstance(element, Mass):
        return element.value
    if isinstance(element, Spring):
        return element.stiffness
    if isinstance(element, Damper):
        return element.coefficient
    return 0.0


def dependence(rig: Rig) -> Dependence:
    """Find out by trial on which parameters every element's value depends, and give every part its unknown."""
    nominal = {c: rig.assembly(c) for c in rig.configurations}
    uncertain = [
        p
        for p in rig.parameters.values()
        if p.name != DAMPING and p.value != 0 and (p.free or p.tolerance > 0)
    ]
    exponents: dict[str, dict[str, dict[PartKey, float]]] = {}
    geometric = []
    for p in uncertain:
        powers = _powers(rig, nominal, p)
        if powers is None:
            geometric.append(p.name)
        elif any(powers.values()):
            exponents[p.name] = powers
    parts = _parts(rig, nominal, exponents)
    families = tuple(exponents)
    names = (*families, *(f"{key[1]} ({key[0].__name__.lower()})" for key in parts))
    joints, pieces = _joints(nominal), _pieces(nominal)
    unknowns = joined(
        Unknowns.plain(
            families, [prior_std(rig.parameters[f]) for f in families], "", *_bounds(rig, families)
        ),
        *(
            Unknowns.plain((name,), std, DIRECTION_SCATTER if key in pieces else _kind(key))
            for name, (key, std) in zip(names[len(families) :], parts.items(), strict=True)
        ),
    )
    return Dependence(
        unknowns,
        _rows(nominal, exponents, families, tuple(parts), len(names)),
        families,
        tuple(geometric),
        np.array([len(families) + i for i, key in enumerate(parts) if key in joints], np.int64),
    )


def _kind(key: PartKey) -> str:
    return MASS_SCATTER if key[0] is Mass else PART_SCATTER


def has_pieces(rig: Rig) -> bool:
    """True where some springs are directions of one piece of hardware."""
    return bool(_pieces({c: rig.assembly(c) for c in rig.configurations}))


def _joints(nominal: Mapping[str, Assembly]) -> set[PartKey]:
    """Springs without a damper beside them."""
    elements = [e for assembly in nominal.values() for e in assembly.elements]
    damped = {_line(e.row) for e in elements if isinstance(e, Damper) and e.coefficient}
    return {part_key(e) for e in elements if isinstance(e, Spring) and _line(e.row) not in damped}


def _line(row: Row) -> frozenset[frozenset[tuple[str, float]]]:
    """What is the same for a row and for the opposite one."""
    return frozenset(frozenset((d, sign * x) for d, x in row.items()) for sign in (1.0, -1.0))


def prior_std(parameter: Parameter) -> float:
    """Prior 1 σ of the logarithm of a parameter: its tolerance, or a quarter of its range where it is free."""
    if not parameter.free:
        return parameter.tolerance
    if not 0 < parameter.minimum < parameter.maximum < np.inf:
        return _UNBOUNDED_STD
    return float(np.clip(np.log(parameter.maximum / parameter.minimum) / 4, *FREE_STD))


def _bounds(rig: Rig, names: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and largest logarithms of parameters over their nominal values, (n,); infinite where there are none."""
    of = [rig.parameters[name] for name in names]
    with np.errstate(divide="ignore"):
        lower = [np.log(max(p.minimum, 0.0) / p.value) for p in of]
    return np.array(lower), np.array([np.log(p.maximum / p.value) for p in of])


def _powers(
    rig: Rig, nominal: Mapping[str, Assembly], parameter: Parameter
) -> dict[str, dict[PartKey, float]] | None:
    """Exponent with which each element's value follows a parameter; None where one does not follow a power."""
    found: dict[str, dict[PartKey, float]] = {}
    for configuration, assembly in nominal.items():
        tries = []
        for factor in (1.05, 0.9):
            other = rig.assembly(configuration, {parameter.name: parameter.value * factor})
            powers = {}
            for before, after in zip(assembly.elements, other.elements, strict=True):
                power = _power(before, after, factor)
                if power is None:
                    return None
                if power:
                    powers[part_key(before)] = power
            tries.append(powers)
        if tries[0].keys() != tries[1].keys() or any(abs(tries[0][k] - tries[1][k]) > 1e-6 for k in tries[0]):
            return None
        found[configuration] = tries[0]
    return found


def _power(before: Element, after: Element, factor: float) -> float | None:
    if before == after:
        return 0.0
    a, b = value_of(before), value_of(after)
    same_row = getattr(before, "row", None) == getattr(after, "row", None)
    if not same_row or a == 0 or b / a <= 0:
        return None
    if isinstance(before, Spring) and isinstance(after, Spring) and before.loss_factor != after.loss_factor:
        return None
    return float(np.log(b / a) / np.log(factor))


def _parts(
    rig: Rig, nominal: Mapping[str, Assembly], exponents: Mapping[str, Mapping[str, Mapping[PartKey, float]]]
) -> dict[PartKey, float]:
    """Every part with the 1 σ of its deviation, in units of its kind's scatter; identical parts have none."""
    parts: dict[PartKey, float] = {}
    pieces = _pieces(nominal)
    for configuration, assembly in nominal.items():
        for element in assembly.elements:
            key = part_key(element)
            if not isinstance(element, Mass | Spring | Damper) or value_of(element) == 0.0 or key in parts:
                continue
            stated = [
                rig.parameters[name].scatter
                for name, powers in exponents.items()
                if powers[configuration].get(key) and rig.parameters[name].scatter is not None
            ]
            default = {Mass: MASS_STD, Spring: STIFFNESS_STD}.get(key[0], DAMPER_STD)
            scatter = stated[0] if stated and stated[0] is not None else default
            if scatter > 0:
                std = scatter / (MASS_STD if key[0] is Mass else STIFFNESS_STD)
                parts[key] = std
                if key in pieces:
                    parts[pieces[key]] = std
    return parts


def _pieces(nominal: Mapping[str, Assembly]) -> dict[PartKey, PartKey]:
    """Key of the piece that a part belongs to, where it belongs to one."""
    springs = (e for assembly in nominal.values() for e in assembly.elements if isinstance(e, Spring))
    return {part_key(e): (Spring, e.piece) for e in springs if e.piece}


def _rows(
    nominal: Mapping[str, Assembly],
    exponents: Mapping[str, Mapping[str, Mapping[PartKey, float]]],
    families: tuple[str, ...],
    parts: tuple[PartKey, ...],
    count: int,
) -> dict[str, dict[PartKey, NDArray[np.float64]]]:
    at = {key: len(families) + i for i, key in enumerate(parts)}
    pieces = _pieces(nominal)
    rows: dict[str, dict[PartKey, NDArray[np.float64]]] = {}
    for configuration, assembly in nominal.items():
        rows[configuration] = {}
        for key in {part_key(e) for e in assembly.elements}:
            row = np.zeros(count)
            for i, name in enumerate(families):
                row[i] = exponents[name][configuration].get(key, 0.0)
            row[[at[k] for k in (key, pieces.get(key)) if k in at]] = 1.0
            if np.any(row):
                rows[configuration][key] = row
    return rows
