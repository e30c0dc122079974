"""What may be missing: every effect at every place, with identical physics as one hypothesis of several names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.out_of_tolerance import proportional_elements, tolerance_effect
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.laws import Nonlinear
from ema_pipeline.mechanics.terms import assemble_terms
from ema_pipeline.observations.size_map import SizeMap
from ema_pipeline.rigs.types import Rig

SAME_PHYSICS = 1 - 1e-9
"""Correlation of two changes of what is calculated from which they are the same physics."""
_MOST_STARTS = 4
_LOG_STARTS = (-1.0, 0.4, 1.5)
"""Unknowns of yields, times and the like from which fits begin: a factor of about four apart."""
_SIZE_STARTS = (0.1, 0.6)
"""The same of a single size that cannot be negative, in units of its prior 1 σ."""
_SIGNED_STARTS = (0.1, 0.3, -0.3)
"""The same of one that has a sign. The first is a twentieth of the measured force, from which a descent passes to the
other sign as well."""


@dataclass(frozen=True)
class Name:
    """One name of a hypothesis, and the prior 1 σ of its size in units of the representative's."""

    placed: PlacedEffect
    scales: Mapping[str, float]
    relative: float = 1.0

    @property
    def label(self) -> str:
        """``id@place``."""
        return self.placed.label


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place, and the other names of the same physics.

    Attributes
    ----------
    names : tuple of Name
        A rig's own effects first, then generic ones.
    begun : tuple of dict of str to float
        Unknowns of the sizes, by ``id@place.name``, from which fits begin; a few usual ones where left out.
    """

    names: tuple[Name, ...]
    begun: tuple[Mapping[str, float], ...] = ()

    @property
    def representative(self) -> Name:
        """The name with the widest prior, whose fit serves for all."""
        return max(self.names, key=lambda n: n.relative)

    @property
    def placed(self) -> PlacedEffect:
        """The effect that is fitted."""
        return self.representative.placed

    @property
    def label(self) -> str:
        """``id@place`` of the effect that is fitted."""
        return self.representative.label

    @property
    def scales(self) -> dict[str, float]:
        """Prior 1 σ of its sizes by ``id@place.name``."""
        one = self.representative
        return {one.placed.parameter_name(k): v for k, v in one.scales.items()}

    @property
    def generic(self) -> bool:
        """True where no effect of the rig's own is among the names."""
        return all(n.placed.effect.generic for n in self.names)

    @property
    def size_cannot_be_zero(self) -> bool:
        """True where the effect is absent at the end of its range only, as a support that is infinitely stiff."""
        return any(SizeMap.of(p, p.scale).logarithmic for p in self.placed.effect.parameters[:1])

    @property
    def has_direction(self) -> bool:
        """True where its other sizes say in which way the first one, which may be zero, acts in proportion to it."""
        effect = self.placed.effect
        return len(effect.parameters) > 1 and effect.linear and not self.size_cannot_be_zero

    @property
    def shown_by_less(self) -> bool:
        """True where the effect shows the more the smaller its size is: teeth part where the motion exceeds it."""
        return self.placed.effect.parameters[0].null == float("inf")

    def starts(self) -> list[dict[str, float]]:
        """Unknowns of the sizes, by ``id@place.name``, from which a fit is begun."""
        if self.begun:
            return [dict(one) for one in self.begun]
        options = []
        for p in self.placed.effect.parameters:
            name = self.placed.parameter_name(p.name)
            size = SizeMap.of(p, self.scales.get(name, p.scale))
            options.append([(name, x) for x in _starts_of(p.unit, size)])
        return [dict(combination) for combination in product(*options)][:_MOST_STARTS]


def _starts_of(unit: str, size: SizeMap) -> tuple[float, ...]:
    if unit == "deg":
        return 0.0, 0.5, 1.0, -0.5
    low, _ = size.bounds
    if size.logarithmic:
        return 0.5, -0.5
    return (0.3, 2.0) if low == 0.0 else (0.5, -0.5)


Groups = list[tuple[NDArray[np.float64] | None, list[Name]]]
"""Changes of what is calculated, and the effects that bring them; None where one is not in proportion to a size."""


def list_hypotheses(
    rig: Rig,
    library: Mapping[str, Effect],
    known: Iterable[str] = (),
    linear: bool = True,
) -> tuple[Hypothesis, ...]:
    """Every effect of the library at every place of the rig, and every parameter that may be out of tolerance.

    Parameters
    ----------
    rig : Rig
        With the effects that it is known to have.
    library : dict of str to Effect
    known : sequence of str
        Labels that are left out: the model has them already.
    linear : bool
        True for effects whose answer is in proportion to the force only.
    """
    skip = set(known)
    assemblies = {c: rig.assembly(c) for c in rig.configurations}
    found = [n for n in _names(rig, assemblies, library, linear) if n.label not in skip]
    return tuple(_merged(found, assemblies))


def _names(
    rig: Rig, assemblies: Mapping[str, Assembly], library: Mapping[str, Effect], linear: bool
) -> list[Name]:
    own: list[Name] = []
    generic: list[Name] = []
    for effect in library.values():
        if (linear and not effect.linear) or effect.records_only:
            continue
        for place in dict.fromkeys(p for a in assemblies.values() for p in effect.find_places(a)):
            assembly = next(a for a in assemblies.values() if effect.fits(a, place))
            (generic if effect.generic else own).append(Name(*PlacedEffect(effect, place).hosted(assembly)))
    for parameter in rig.parameters.values():
        known = not parameter.free and parameter.value != 0  # also where no tolerance is stated
        if known and proportional_elements(rig, parameter.name):
            own.append(Name(tolerance_effect(rig, parameter.name), {}))
    return own + generic


def _merged(names: Sequence[Name], assemblies: Mapping[str, Assembly]) -> list[Hypothesis]:
    """Names whose changes of all matrices are proportional to each other, or which add the same nonlinear elements, as
    one hypothesis."""
    groups: Groups = []
    nonlinear: dict[object, list[Name]] = {}
    for name in names:
        if (added := _added(name, assemblies)) is not None:
            if added not in nonlinear:
                groups.append((None, nonlinear.setdefault(added, [])))
            nonlinear[added].append(name)
            continue
        change = _change(name, assemblies)
        if change is None or np.any(change):
            put_among(groups, name, change)
    return [Hypothesis(tuple(members)) for _, members in groups]


def put_among(
    groups: Groups, name: Name, change: NDArray[np.float64] | None, same: float = SAME_PHYSICS
) -> None:
    """Put an effect beside those whose changes its own is in proportion to, or after all where there are none."""
    size = 0.0 if change is None else float(np.linalg.norm(change))
    for known, names in groups:
        if known is None or change is None or known.shape != change.shape:
            continue
        reference = float(np.linalg.norm(known))
        if float(known @ change) > same * reference * size:
            names.append(replace(name, relative=size / reference))
            return
    groups.append((change, [name]))


def _added(name: Name, assemblies: Mapping[str, Assembly]) -> object | None:
    """What a nonlinear effect gives every assembly, whatever it is called there; None for others.

    On a rig of one direction friction at a body is that at its only DOF.
    """
    if name.placed.effect.linear:
        return None
    told = {c: name.placed.nonlinear_of(assembly) for c, assembly in assemblies.items()}
    if not any(told.values()) or any(e.law is None for elements in told.values() for e in elements):
        return None  # it has a memory, or acts otherwise
    return name.placed.effect.id, tuple(
        (c, tuple(sorted((e.law, _row(e)) for e in elements))) for c, elements in told.items()
    )


def _row(element: Nonlinear) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((dof, round(share, 9)) for dof, share in element.row.items()))


def _change(name: Name, assemblies: Mapping[str, Assembly]) -> NDArray[np.float64] | None:
    """Change of all matrices by one prior 1 σ of the size; None where it is not in proportion to one size."""
    effect, place = name.placed.effect, name.placed.place
    if len(effect.parameters) != 1:
        return None
    p = effect.parameters[0]
    size = SizeMap.of(p, name.scales.get(p.name, p.scale))
    if size.logarithmic or not effect.linear:
        return None
    changes = []
    for assembly in assemblies.values():
        before = _matrices(assembly)
        for x in (0.5, 1.0):
            value = size.value(x * min(1.0, 0.5 * size.bounds[1]))
            after = before
            if effect.fits(assembly, place):
                after = _matrices(effect.edit(assembly, place, {p.name: value}))
            if after.shape != before.shape:
                return None
            changes.append((after - before) / max(abs(value - p.null), 1e-300) * size.scale)
    half, full = np.concatenate(changes[0::2]), np.concatenate(changes[1::2])
    if float(np.linalg.norm(full - half)) > 1e-6 * float(np.linalg.norm(full)):
        return None
    return full


def _matrices(assembly: Assembly) -> NDArray[np.float64]:
    terms = assemble_terms(assembly, {}, lambda e: e.name)
    dense = terms.dense(terms.coefficient)
    return np.concatenate([dense.ravel(), terms.skew.ravel()])


def size_starts(placed: PlacedEffect) -> tuple[Mapping[str, float], ...]:
    """Unknowns from which fits to forces in time begin: the first size, and the shape that follows it."""
    options = []
    for k, p in enumerate(placed.effect.parameters):
        size = SizeMap.of(p, p.scale)
        low, high = size.bounds
        starts: tuple[float, ...] = (0.0,)
        if size.logarithmic and k < 2:
            starts = _LOG_STARTS
        elif not size.logarithmic and len(placed.effect.parameters) == 1:
            starts = _SIZE_STARTS if low == 0.0 else _SIGNED_STARTS
        elif k == 0:
            starts = (0.3,)
        name = placed.parameter_name(p.name)
        options.append([(name, float(np.clip(s, low, high))) for s in starts])
    return tuple(dict(combination) for combination in product(*options))
