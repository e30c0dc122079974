"""How a configuration's terms depend on the effects' sizes, so that the rig is not assembled anew at every size.

Most effects change coefficients, which are linear in their sizes. Some add elements whose rows depend on them, as a
stiff axis turns with its angle: these few elements are made anew, and no others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.terms import Terms, assemble_terms
from ema_pipeline.observations.parts import PartKey, part_key
from ema_pipeline.observations.size_map import SizeMap

Real = NDArray[np.float64]
Slopes = tuple[Real, Real]
"""Derivatives of the matrices and of their skew part by the unknowns, (k, 4, n, n) and (k, n, n)."""

_BEGIN, _FURTHER = 0.2, 1.5
"""Unknown of a size at which terms are assembled, and the factor on its coordinate at which they are once more."""
_TRIED = (0.6, 1.3)
"""Such factors at which what was found is tried."""
_DIFFERENCE = 1e-4
"""Step of the differences by effects' sizes, in units of their prior σ."""
_SAME = 1e-9
"""Relative difference up to which coefficients and matrices are the same."""


@dataclass(frozen=True)
class LinearTerms:
    """Terms whose coefficients are linear functions of sizes' coordinates (`SizeMap.coordinate`).

    Attributes
    ----------
    sizes : tuple of SizeMap
    start : Terms
        At `begin`.
    begin : ndarray, (k,)
    slopes : ndarray, (k, t)
        Derivatives of the coefficients.
    skew_slopes : ndarray, (k, n, n)
    """

    sizes: tuple[SizeMap, ...]
    start: Terms
    begin: Real
    slopes: Real
    skew_slopes: Real

    @classmethod
    def found(cls, sizes: Sequence[SizeMap], assembled: Callable[[Real], Terms | None]) -> LinearTerms | None:
        """The function through a few sizes, tried at others; None where there is none.

        Parameters
        ----------
        sizes : sequence of SizeMap
        assembled : callable
            Terms at the sizes' unknowns, (k,), None where there are none of that kind.
        """
        begin = _begin(sizes)

        def at(coordinates: Real) -> Terms | None:
            return assembled(_unknowns(sizes, coordinates))

        start = at(begin)
        if start is None:
            return None
        slopes, skews = [], []
        for i in range(len(begin)):
            other = at(begin * np.where(np.arange(len(begin)) == i, _FURTHER, 1.0))
            if other is None or not _same_rows(start, other):
                return None
            slopes.append((other.coefficient - start.coefficient) / ((_FURTHER - 1) * begin[i]))
            skews.append((other.skew - start.skew) / ((_FURTHER - 1) * begin[i]))
        n = len(start.dofs)
        linear = cls(
            tuple(sizes),
            start,
            begin,
            np.array(slopes).reshape(len(begin), len(start.coefficient)),
            np.array(skews).reshape(len(begin), n, n),
        )
        for share in _TRIED if len(begin) else ():
            trial, told = at(share * begin), linear._at(share * begin)
            if trial is None or not _same_rows(start, trial):
                return None
            if not np.allclose(told.coefficient, trial.coefficient, rtol=_SAME):
                return None
        return linear

    @classmethod
    def joined(cls, parts: Sequence[LinearTerms]) -> LinearTerms:
        """The terms of several parts with the same coordinates, none of which depends on another's sizes."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            tuple(s for p in parts for s in p.sizes),
            Terms.joined([p.start for p in parts]),
            np.concatenate([p.begin for p in parts]),
            scipy.linalg.block_diag(*(p.slopes for p in parts)),
            np.concatenate([p.skew_slopes for p in parts]),
        )

    def at(self, unknowns: Real) -> Terms:
        """Terms at the sizes' unknowns, (k,)."""
        return self._at(np.array([s.coordinate(float(x)) for s, x in zip(self.sizes, unknowns, strict=True)]))

    def _at(self, coordinates: Real) -> Terms:
        if not len(self.begin):
            return self.start
        moved = coordinates - self.begin
        s = self.start
        skew = s.skew
        if np.any(self.skew_slopes):
            skew = skew + np.tensordot(moved, self.skew_slopes, axes=1)
        found = Terms(s.dofs, s.rows, s.coefficient + moved @ self.slopes, s.matrix, s.log, skew)
        found.__dict__["by_kind"] = s.by_kind  # the rows are the same ones
        return found

    def slopes_at(self, unknowns: Real, logs: Real) -> Slopes:
        """Exact derivatives at the sizes' unknowns, (k,), and the rig's unknown logarithms."""
        n, factor = len(self.start.dofs), np.exp(self.start.log @ logs)
        dense, skew = np.zeros((len(self.sizes), 4, n, n)), np.zeros((len(self.sizes), n, n))
        for i, (size, x) in enumerate(zip(self.sizes, unknowns, strict=True)):
            slope = size.coordinate_slope(float(x))
            dense[i] = slope * self.start.dense(self.slopes[i] * factor)
            skew[i] = slope * self.skew_slopes[i]
        return dense, skew


@dataclass(frozen=True)
class AddedTerms:
    """Terms of the elements that one effect adds to a rig.

    Attributes
    ----------
    host : Assembly
        The rig without any effect.
    dependent : dict to ndarray, (u,)
        See `assemble_terms`.
    effect : PlacedEffect
    sizes : tuple of SizeMap
    """

    host: Assembly
    dependent: Mapping[PartKey, Real]
    effect: PlacedEffect
    sizes: tuple[SizeMap, ...]

    @cached_property
    def fits(self) -> bool:
        """True where the rig has the effect's place."""
        return self.effect.effect.fits(self.host, self.effect.place)

    def at(self, unknowns: Real, dofs: tuple[str, ...] = ()) -> Terms | None:
        """Terms at the sizes' unknowns, (k,); None where the effect does more than add elements.

        With the coordinates `dofs` where others add some.
        """
        if not self.fits:
            return None
        names = [p.name for p in self.effect.effect.parameters]
        values = {n: s.value(float(x)) for n, s, x in zip(names, self.sizes, unknowns, strict=True)}
        edited = self.effect.effect.edit(self.host, self.effect.place, values)
        before = len(self.host.elements)
        if edited.dofs != self.host.dofs or edited.elements[:before] != self.host.elements:
            return None
        added = Assembly(dofs or edited.dofs, edited.elements[before:])
        return assemble_terms(added, self.dependent, part_key)

    @cached_property
    def adds(self) -> bool:
        """True where the effect adds elements, and does no more than that."""
        return self.at(_unknowns(self.sizes, _begin(self.sizes))) is not None

    @cached_property
    def _linear(self) -> LinearTerms | None:
        return LinearTerms.found(self.sizes, self.at)

    def linear(self, dofs: tuple[str, ...]) -> LinearTerms | None:
        """Its terms with these coordinates where they are linear in its sizes."""
        if dofs == self.host.dofs:
            return self._linear
        return LinearTerms.found(self.sizes, partial(self.at, dofs=dofs))


@dataclass(frozen=True)
class EffectTerms:
    """All terms of a configuration: those that are linear in sizes' coordinates, and those of elements made anew.

    Attributes
    ----------
    linear : LinearTerms
    places : ndarray of int
        Positions of its sizes among those of all effects.
    added : tuple of (AddedTerms, slice)
        With those of theirs.
    """

    linear: LinearTerms
    places: NDArray[np.int64]
    added: tuple[tuple[AddedTerms, slice], ...] = ()

    @classmethod
    def found(
        cls,
        each: Sequence[AddedTerms],
        assembled: Callable[[Real, frozenset[int]], Terms],
    ) -> EffectTerms | None:
        """With the fewest elements made anew; None where the terms depend on the sizes in yet another way.

        Parameters
        ----------
        each : sequence of AddedTerms
            Of every effect, as if it were the only one.
        assembled : callable
            Terms of the rig at all sizes' unknowns, (k,), without the effects of these numbers.
        """
        sizes = [s for one in each for s in one.sizes]
        found = cls._of_each(each, sizes, assembled)
        if found is not None:
            return found
        linear = LinearTerms.found(sizes, lambda x: assembled(x, frozenset()))
        return None if linear is None else cls(linear, np.arange(len(sizes)))

    @classmethod
    def _of_each(
        cls,
        each: Sequence[AddedTerms],
        sizes: Sequence[SizeMap],
        assembled: Callable[[Real, frozenset[int]], Terms],
    ) -> EffectTerms | None:
        """With what effects add each on its own, beside the rig with all others; None where they depend on these."""
        ends = np.cumsum([0, *(len(one.sizes) for one in each)])
        own = [np.arange(a, b) for a, b in pairwise(ends)]
        adding = [i for i, one in enumerate(each) if one.adds]
        rest = np.array([k for i in range(len(each)) if i not in adding for k in own[i]], np.int64)
        begin = _unknowns(sizes, _begin(sizes))

        def without(unknowns: Real) -> Terms:
            x = begin.copy()
            x[rest] = unknowns
            return assembled(x, frozenset(adding))

        others = LinearTerms.found([sizes[k] for k in rest], without)
        if others is None:
            return None
        parts, places, added = [others], [rest], []
        for i in adding:
            linear = each[i].linear(others.start.dofs)
            if linear is None:
                added.append((each[i], slice(int(ends[i]), int(ends[i + 1]))))
            else:
                parts.append(linear)
                places.append(own[i])
        terms = cls(LinearTerms.joined(parts), np.concatenate(places), tuple(added))
        tried = _unknowns(sizes, _TRIED[0] * _begin(sizes))
        return terms if terms._is(assembled(tried, frozenset()), tried) else None

    def at(self, unknowns: Real) -> Terms | None:
        """Terms at all sizes' unknowns, (k,); None where an effect does more than add elements there."""
        found = [self.linear.at(unknowns[self.places])]
        for one, place in self.added:
            added = one.at(unknowns[place], self.linear.start.dofs)
            if added is None:
                return None
            found.append(added)
        return found[0] if len(found) == 1 else Terms.joined(found)

    def slopes_at(self, unknowns: Real, logs: Real) -> Slopes | None:
        """Derivatives at all sizes' unknowns, (k,), and the rig's unknown logarithms; None as in `at`."""
        own = self.linear.slopes_at(unknowns[self.places], logs)
        dense, skew = (np.zeros((len(unknowns), *a.shape[1:])) for a in own)
        dense[self.places], skew[self.places] = own
        for one, place in self.added:
            dofs = self.linear.start.dofs
            found = differences(partial(one.at, dofs=dofs), unknowns[place], logs, len(dofs))
            if found is None:
                return None
            dense[place], skew[place] = found
        return dense, skew

    def _is(self, other: Terms, unknowns: Real) -> bool:
        """True where these are the same matrices as of other terms, whatever the rig's unknowns."""
        found = self.at(unknowns)
        if found is None or found.dofs != other.dofs:
            return False
        logs = 0.1 * np.cos(np.arange(found.log.shape[1]))
        own, its = (np.concatenate([t.dense(t.scaled(logs)), t.skew[None]]) for t in (found, other))
        largest = np.max(np.abs(its), axis=(1, 2), keepdims=True)
        return bool(np.all(np.abs(own - its) <= _SAME * largest))


def differences(terms: Callable[[Real], Terms | None], unknowns: Real, logs: Real, n: int) -> Slopes | None:
    """Derivatives of n × n matrices by small differences of sizes' unknowns, (k,); 0 where a size changes n."""
    dense, skew = np.zeros((len(unknowns), 4, n, n)), np.zeros((len(unknowns), n, n))
    for i in range(len(unknowns)):
        ends = []
        for h in (-_DIFFERENCE, _DIFFERENCE):
            moved = unknowns.copy()
            moved[i] += h
            other = terms(moved)
            if other is None:
                return None
            ends.append((other.dense(other.scaled(logs)), other.skew))
        if ends[0][0].shape == dense[i].shape == ends[1][0].shape:
            dense[i] = (ends[1][0] - ends[0][0]) / (2 * _DIFFERENCE)
            skew[i] = (ends[1][1] - ends[0][1]) / (2 * _DIFFERENCE)
    return dense, skew


def _begin(sizes: Sequence[SizeMap]) -> Real:
    """Coordinates of sizes that are not at an end of their range, (k,)."""
    return np.array(
        [1.0 if s.logarithmic else np.clip(_BEGIN, 0.5 * s.bounds[0], 0.5 * s.bounds[1]) for s in sizes]
    )


def _unknowns(sizes: Sequence[SizeMap], coordinates: Real) -> Real:
    """Unknowns at sizes' coordinates, (k,)."""
    return np.array([s.of_coordinate(float(z)) for s, z in zip(sizes, coordinates, strict=True)])


def _same_rows(a: Terms, b: Terms) -> bool:
    return (
        a.dofs == b.dofs
        and a.rows.shape == b.rows.shape
        and bool(np.array_equal(a.rows, b.rows))
        and bool(np.array_equal(a.matrix, b.matrix))
        and bool(np.array_equal(a.log, b.log))
    )
