"""Steady force of elements side by side whose common stretch is prescribed, along many cycles at once.

A cycle is taken as one way up and one way down; reversals in between, which a noisy displacement has, are passed
over. Laws with memory then depend on the way since the last turning point only, so nothing is stepped in time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Damper, Element, Spring
from ema_pipeline.mechanics.fourier import fourier, fourier_slope
from ema_pipeline.mechanics.laws import (
    BoucWen,
    DryFriction,
    LooseSpring,
    Maxwell,
    Nonlinear,
    PartingSpring,
    PolynomialSpring,
)
from ema_pipeline.mechanics.limit_cycle import LimitCycle
from ema_pipeline.mechanics.nonlinear import steady_deviation

_STEPS = 512
"""Points per cycle at which a law without a closed form is stepped."""
_ROUNDS = 3
"""Passes in which the stretch of a Maxwell branch behind play settles."""
_HARMONICS = 12
"""Of a stretch with play, by which the damper of a Maxwell branch follows it; it hardly sees higher ones."""
_MOST_PLAY = 0.98
"""Share of the way of a cycle that play takes at most: a little contact is left, so that the force has a size."""


@dataclass(frozen=True)
class Points:
    """Points of several cycles at which forces are wanted, whatever the motion.

    Attributes
    ----------
    frequency_hz : tuple of float
    phase : tuple of ndarray
        Phases of each cycle's points, in cycles.
    harmonics : tuple of int
        Of each cycle's displacement.
    """

    frequency_hz: tuple[float, ...]
    phase: tuple[NDArray[np.float64], ...]
    harmonics: tuple[int, ...]

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Points of each cycle among all."""
        ends = np.cumsum([0] + [len(p) for p in self.phase])
        return tuple(slice(int(a), int(b)) for a, b in pairwise(ends))

    @cached_property
    def bases(self) -> tuple[NDArray[np.float64], ...]:
        """Fourier series at each cycle's points, as far as its displacement goes."""
        return tuple(fourier(p, n) for p, n in zip(self.phase, self.harmonics, strict=True))

    @cached_property
    def followed(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
        """Longer Fourier series at each cycle's points, and its least-squares inverse."""
        bases = [fourier(p, _HARMONICS) for p in self.phase]
        return tuple((basis, np.asarray(np.linalg.pinv(basis), dtype=np.float64)) for basis in bases)


@dataclass(frozen=True)
class Cycles:
    """Motion of several steady cycles, one after the other.

    Attributes
    ----------
    points : Points
    series : tuple of ndarray, (2·n_harmonics + 1,)
        Fourier coefficients of each displacement: mean, cosines, sines, m.
    x, velocity : ndarray, (n_points,)
        Displacement, m, and its rate, m/s, at all points.
    way, span : ndarray, (n_points,)
        Way since the last turning point, and between turning points, m.
    direction : ndarray, (n_points,)
        +1 on the way up, -1 on the way down.
    """

    points: Points
    series: tuple[NDArray[np.float64], ...]
    x: NDArray[np.float64]
    velocity: NDArray[np.float64]
    way: NDArray[np.float64]
    span: NDArray[np.float64]
    direction: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        frequency_hz: Sequence[float],
        series: Sequence[NDArray[np.float64]],
        phase: Sequence[NDArray[np.float64]],
    ) -> Cycles:
        """Cycles whose displacements have these Fourier coefficients, at these phases."""
        x = [fourier(p, len(s) // 2) @ s for p, s in zip(phase, series, strict=True)]
        v = [
            fourier_slope(p, len(s) // 2) @ s * f for f, p, s in zip(frequency_hz, phase, series, strict=True)
        ]
        ways = [_ways(one) for one in x]
        return cls(
            points=Points(tuple(frequency_hz), tuple(phase), tuple(len(s) // 2 for s in series)),
            series=tuple(series),
            x=np.concatenate(x),
            velocity=np.concatenate(v),
            way=np.concatenate([way for _, way in ways]),
            span=np.concatenate([np.full(len(one), np.ptp(one)) for one in x]),
            direction=np.concatenate([direction for direction, _ in ways]),
        )

    def scaled(self, factor: float) -> Cycles:
        """The same cycles with all displacements times `factor`."""
        if factor <= 0.0:  # the other way round: ups become downs
            return Cycles.of(self.points.frequency_hz, [factor * s for s in self.series], self.points.phase)
        return replace(
            self,
            series=tuple(factor * s for s in self.series),
            **{n: factor * getattr(self, n) for n in ("x", "velocity", "way", "span")},
        )

    def force(self, elements: Sequence[Element]) -> NDArray[np.float64]:
        """Force of elements side by side, N, (n_points,).

        Parameters
        ----------
        elements : sequence
            All with the prescribed stretch; a `LooseSpring` lets all of them have its play.
        """
        path = self.met_by(elements)
        return _total([path.force_of(e) for e in elements], len(self.x))

    def met_by(self, elements: Sequence[Element]) -> Cycles | Contact:
        """What the elements see of the motion: all of it, or what play leaves of it."""
        loose = next((e for e in elements if isinstance(e, LooseSpring)), None)
        return self if loose is None else Contact.of(self, elements, -2 * loose.preload)

    def force_of(self, element: Element) -> NDArray[np.float64]:
        """Force of one element, N, (n_points,)."""
        for kind, law in _LAWS:
            if isinstance(element, kind):
                return law(self, element)
        if isinstance(element, Nonlinear):
            return self._stepped(element)
        raise EmaError(f"element '{element.name}' has no force along a prescribed stretch")

    def filtered(
        self, factor: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
    ) -> NDArray[np.float64]:
        """Displacement with every harmonic times a complex factor of its angular frequency, (n_points,)."""
        found = np.empty(len(self.x))
        p = self.points
        for f, s, part, basis in zip(p.frequency_hz, self.series, p.parts, p.bases, strict=True):
            n = len(s) // 2
            omega = np.asarray(2 * np.pi * f * np.arange(1, n + 1), dtype=np.float64)
            c = (s[1 : n + 1] - 1j * s[n + 1 :]) * factor(omega)
            found[part] = basis @ np.concatenate([[0.0], c.real, -c.imag])
        return found

    def _stepped(self, element: Nonlinear) -> NDArray[np.float64]:
        """Force of a law without a closed form, stepped through each cycle."""
        found = np.empty(len(self.x))
        grid = np.arange(_STEPS) / _STEPS
        p = self.points
        for f, s, phase, part in zip(p.frequency_hz, self.series, p.phase, p.parts, strict=True):
            x, v = fourier(grid, len(s) // 2) @ s, fourier_slope(grid, len(s) // 2) @ s * f
            force = element.tangent_stiffness * x + element.tangent_damping * v
            force += steady_deviation(element, x, v, 1 / (f * _STEPS))
            found[part] = np.interp(phase, grid, force, period=1.0)
        return found


@dataclass(frozen=True)
class Contact:
    """What elements see of cycles that have to run through their common play first.

    Before the play the back contact carries (stretch x + s·gap/2, s the direction), after it the front contact. Where
    the force would have to pull at a contact it is zero, and the elements stay as they are. The force is continuous
    where contact is lost or found, so that its derivatives by the elements are those at fixed contact.

    Attributes
    ----------
    back, front : Cycles
        The elements' motion while either contact carries.
    before, after : ndarray of bool, (n_points,)
        Where each does.
    stretch : ndarray, (n_points,)
        Of the elements at all points, m.
    """

    back: Cycles
    front: Cycles
    before: NDArray[np.bool_]
    after: NDArray[np.bool_]
    stretch: NDArray[np.float64]

    @classmethod
    def of(cls, cycles: Cycles, elements: Sequence[Element], gap: float) -> Contact:
        """Contact of elements with a play of `gap`, m."""
        gaps = np.minimum(gap, _MOST_PLAY * cycles.span)
        s = cycles.direction
        span = cycles.span - gaps
        back = replace(cycles, x=cycles.x + 0.5 * s * gaps, span=span)
        late = np.maximum(cycles.way - gaps, 0.0)
        front = replace(cycles, x=cycles.x - 0.5 * s * gaps, span=span, way=late)
        branches = [e for e in elements if isinstance(e, Maxwell)]
        others = [_without_play(e) for e in elements if not isinstance(e, Maxwell)]
        in_back, in_front = (_total([p.force_of(e) for e in others], len(cycles.x)) for p in (back, front))
        before, after = _touching(s, in_back, in_front)
        stretch = _held(back, front, before, after)
        for _ in range(_ROUNDS if branches else 0):
            forces = [e.stiffness * _relaxed(cycles.points, stretch, e.time) for e in branches]
            more = _total(forces, len(cycles.x))
            before, after = _touching(s, in_back + more, in_front + more)
            stretch = _held(back, front, before, after)
        return cls(back, front, before, after, stretch)

    def scaled(self, factor: float) -> Contact:
        """The same contact with all displacements times `factor` > 0."""
        return replace(
            self,
            back=self.back.scaled(factor),
            front=self.front.scaled(factor),
            stretch=factor * self.stretch,
        )

    def force_of(self, element: Element) -> NDArray[np.float64]:
        """Force of one element, N, (n_points,)."""
        if isinstance(element, Maxwell):
            force = element.stiffness * _relaxed(self.back.points, self.stretch, element.time)
            return np.where(self.before | self.after, force, 0.0)
        inner = _without_play(element)
        front = np.where(self.after, self.front.force_of(inner), 0.0)
        return np.where(self.before, self.back.force_of(inner), front)


def _spring(cycles: Cycles, e: Spring) -> NDArray[np.float64]:
    if e.loss_factor == 0.0:
        return e.stiffness * cycles.x
    return e.stiffness * (cycles.x + e.loss_factor * cycles.filtered(_quarter_turn))


def _quarter_turn(omega: NDArray[np.float64]) -> NDArray[np.complex128]:
    return np.full(len(omega), 1j)


def _parting(cycles: Cycles, e: PartingSpring) -> NDArray[np.float64]:
    return e.stiffness * cycles.x + e.along(cycles.x, cycles.velocity, 0.0, 0.0, 0.0)


def _damper(cycles: Cycles, e: Damper) -> NDArray[np.float64]:
    return e.coefficient * cycles.velocity


def _polynomial(cycles: Cycles, e: PolynomialSpring) -> NDArray[np.float64]:
    return (e.quadratic + e.cubic * cycles.x) * cycles.x**2


def _friction(cycles: Cycles, e: DryFriction) -> NDArray[np.float64]:
    return e.limit * np.tanh(cycles.velocity / e.velocity)


def _bouc_wen(cycles: Cycles, e: BoucWen) -> NDArray[np.float64]:
    state = _limit_cycle(e.sigma, e.exponent).along(e.rho * cycles.way, e.rho * cycles.span)
    return e.limit * cycles.direction * state


def _maxwell(cycles: Cycles, e: Maxwell) -> NDArray[np.float64]:
    def followed(omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        turned = 1j * np.asarray(omega * e.time, dtype=np.float64)
        return np.asarray(turned / (1 + turned), dtype=np.complex128)

    return e.stiffness * cycles.filtered(followed)


_LAWS: tuple[tuple[type, Callable[..., NDArray[np.float64]]], ...] = (
    (PartingSpring, _parting),
    (Spring, _spring),
    (Damper, _damper),
    (PolynomialSpring, _polynomial),
    (DryFriction, _friction),
    (BoucWen, _bouc_wen),
    (Maxwell, _maxwell),
)
"""Closed forms; a `PartingSpring` is a `Spring` too and comes first."""


def _without_play(element: Element) -> Element:
    if isinstance(element, LooseSpring):
        return Spring(element.name, element.row, element.stiffness, element.loss_factor)
    return element


def _total(forces: Sequence[NDArray[np.float64]], count: int) -> NDArray[np.float64]:
    return np.sum(forces, axis=0) if forces else np.zeros(count)


def _held(
    back: Cycles, front: Cycles, before: NDArray[np.bool_], after: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Stretch of elements behind play: while it is run through they stay where the contact was lost."""
    u = np.where(before, back.x, front.x)
    carried, at = before | after, np.arange(len(u))
    starts = [part.start for part in back.points.parts]
    latest = np.maximum.accumulate(np.where(carried, at, -1))
    last = np.maximum.reduceat(np.where(carried, at, -1), starts)
    owner = np.repeat(np.arange(len(starts)), np.diff([*starts, len(u)]))
    first = np.asarray(starts)[owner]
    source = np.where(latest >= first, latest, last[owner])  # before the first contact of a cycle: its last
    return np.where(carried | (source < 0), u, u[source])


def _relaxed(points: Points, stretch: NDArray[np.float64], time: float) -> NDArray[np.float64]:
    """Force of a Maxwell branch of 1 N/m along periodic stretches: the stretch less that of its damper."""
    found = np.empty(len(stretch))
    order = np.arange(1, _HARMONICS + 1)
    for f, part, (basis, inverse) in zip(points.frequency_hz, points.parts, points.followed, strict=True):
        c = inverse @ stretch[part]
        late = (c[1 : _HARMONICS + 1] - 1j * c[_HARMONICS + 1 :]) / (1 + 2j * np.pi * time * f * order)
        found[part] = stretch[part] - basis @ np.concatenate([c[:1], late.real, -late.imag])
    return found


def _touching(
    direction: NDArray[np.float64], back: NDArray[np.float64], front: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Points at which the back and at which the front contact carries, from the force that each would have."""
    before = direction * back < 0
    return before, ~before & (direction * front > 0)


def _ways(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direction, ±1, and way since the last turning point of a cycle, m, each (n_points,)."""
    bottom, top = int(np.argmin(x)), int(np.argmax(x))
    order = (np.arange(len(x)) - bottom) % len(x)
    rising = order <= (top - bottom) % len(x)
    way = np.empty(len(x))
    for up in (True, False):
        mine = np.flatnonzero(rising == up)
        mine = mine[np.argsort(order[mine])]
        way[mine] = np.maximum.accumulate(x[mine] - x[bottom] if up else x[top] - x[mine])
    return np.where(rising, 1.0, -1.0), way


@lru_cache(maxsize=256)
def _limit_cycle(sigma: float, exponent: float) -> LimitCycle:
    return LimitCycle(sigma, exponent)
