"""The isolator's force along loops: a sum of elements, most of whose parameters enter linearly.

Force = K1 x + K2 x² + K3 x³ + c ẋ + k_w w(ρ, σ, n; x) + relaxation(τ; x) + an offset per loop. With free play
the elements see the motion less the play: where the force would change its sign, it stays at zero until the
play has been run through. Or only the spring has the play, and the others go on beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.assembly import Damper, Element, Spring
from ema_pipeline.mechanics.fourier import fourier, fourier_slope
from ema_pipeline.mechanics.laws import BoucWen, Maxwell, PolynomialSpring
from ema_pipeline.mechanics.limit_cycle import LimitCycle
from ema_pipeline.mechanics.nonlinear import force_along, steady_deviation

STIFFNESS, QUADRATIC, CUBIC = "stiffness", "quadratic_stiffness", "cubic_stiffness"
DAMPING, FORCE, RELAXATION = "viscous_damping", "hysteresis_force", "relaxation_stiffness"
RHO, SIGMA, TIME = "hysteresis_rho", "hysteresis_sigma", "relaxation_time"
EXPONENT, GAP, SPRING_GAP = "hysteresis_exponent", "backlash_gap", "backlash_gap_of_spring"
GAPS = (GAP, SPRING_GAP)
"""Free play of the whole isolator, and free play of its spring alone."""
UNITS = {
    STIFFNESS: "N/m",
    QUADRATIC: "N/m²",
    CUBIC: "N/m³",
    DAMPING: "N·s/m",
    FORCE: "N",
    RELAXATION: "N/m",
    RHO: "1/m",
    SIGMA: "1",
    EXPONENT: "1",
    TIME: "s",
    GAP: "m",
    SPRING_GAP: "m",
}
Terms = tuple[str, ...]
"""Names of linear parameters, in the order of their columns."""

_ROW = {"isolator.x": 1.0}
POINTS = 512
"""Points per cycle at which the elements are run through."""
_POWERS = {STIFFNESS: 1, QUADRATIC: 2, CUBIC: 3}
_ROUNDS = 3
_HARMONICS = 12
"""Of a stretch with play, by which the damper of a Maxwell branch follows it; it hardly sees higher ones."""


def elements(values: Mapping[str, float]) -> tuple[Element, ...]:
    """The isolator as elements of the mechanics, without free play."""
    found: list[Element] = [
        Spring("stiffness", _ROW, values.get(STIFFNESS, 0.0)),
        PolynomialSpring("curvature", _ROW, values.get(QUADRATIC, 0.0), values.get(CUBIC, 0.0)),
        Damper("viscous", _ROW, values.get(DAMPING, 0.0)),
    ]
    if values.get(FORCE):
        exponent = values.get(EXPONENT, 1.0)
        found.append(BoucWen("hysteresis", _ROW, values[FORCE], values[RHO], values[SIGMA], exponent))
    if values.get(RELAXATION):
        found.append(Maxwell("relaxation", _ROW, values[RELAXATION], values[TIME]))
    return tuple(found)


def loop_force(
    values: Mapping[str, float],
    series: NDArray[np.float64],
    frequency_hz: float,
    phase: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Steady force of an isolator without play at phases of the cycle, N, (n_points,).

    Parameters
    ----------
    values : dict of str to float
        Parameters named as in `IsolatorResult.parameters`.
    series : ndarray, (2·n_harmonics + 1,)
        Fourier coefficients of the displacement, m.
    frequency_hz : float
    phase : ndarray, (n_points,)
        In cycles.
    """
    harmonics = len(series) // 2
    grid = np.arange(POINTS) / POINTS
    x = fourier(grid, harmonics) @ series
    v = fourier_slope(grid, harmonics) @ series * frequency_hz
    step = 1 / (frequency_hz * POINTS)
    force = force_along(elements(values), x, v, step, deviation=steady_deviation)
    return np.interp(phase, grid, force, period=1.0)


class Motion:
    """Motion of several loops, and the force that an isolator answers it with, fast enough for thousands of fits.

    A loop is taken as one way up and one way down; reversals in between, which a noisy displacement has, are
    passed over.

    Attributes
    ----------
    parts : list of slice
        Points of each loop among all.
    x, velocity, way, span, direction : ndarray, (n_points,)
        Displacement, m; velocity, m/s; way since the last turning point and between turning points, m; +1 on
        the way up, -1 on the way down.
    """

    def __init__(self, loops: Sequence[Loop]) -> None:
        self.loops = tuple(loops)
        ends = np.cumsum([0] + [len(loop.force) for loop in loops])
        self.parts = [slice(int(a), int(b)) for a, b in pairwise(ends)]
        self.x = np.concatenate([loop.displacement for loop in loops])
        self.velocity = np.concatenate([loop.velocity for loop in loops])
        self.span = np.repeat([np.ptp(loop.displacement) for loop in loops], np.diff(ends))
        ways = [_ways(loop.displacement) for loop in loops]
        self.direction = np.concatenate([direction for direction, _ in ways])
        self.way = np.concatenate([way for _, way in ways])
        self._fixed = {STIFFNESS: self.x, QUADRATIC: self.x**2, CUBIC: self.x**3, DAMPING: self.velocity}

    def force(
        self, values: Mapping[str, float], terms: Terms
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force, N, (n_points,), and its slopes by the linear `terms`, (n_points, n_terms)."""
        p = np.array([values[t] for t in terms])
        gap = values.get(GAP, 0.0)
        if gap == 0.0:
            columns = np.stack([self.column(t, values) for t in terms], axis=1)
            return columns @ p, columns
        # Before the play the back contact carries (stretch x + s·gap/2), after it the front contact.
        s = self.direction
        gaps = np.minimum(gap, 0.98 * self.span)
        back = self._contact(values, terms, self.x + 0.5 * s * gaps, self.way, gaps)
        front = self._contact(values, terms, self.x - 0.5 * s * gaps, np.maximum(self.way - gaps, 0.0), gaps)
        before, after = _touching(s, back @ p, front @ p)
        if RELAXATION in terms:
            at = terms.index(RELAXATION)
            for _ in range(_ROUNDS):
                late = self._relaxed(self._held(gaps, before, after), values[TIME])
                back[:, at] = front[:, at] = late
                before, after = _touching(s, back @ p, front @ p)
        columns = np.where(before[:, None], back, np.where(after[:, None], front, 0.0))
        return columns @ p, columns

    def column(self, term: str, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Force without play by one linear term of size 1, (n_points,)."""
        if term == FORCE:
            return self._hysteresis(values, self.way, self.span)
        if term == RELAXATION:
            return self._relaxation(values[TIME])
        if SPRING_GAP in values and term in _POWERS:
            half = 0.5 * values[SPRING_GAP]
            return np.asarray((self.x - np.clip(self.x, -half, half)) ** _POWERS[term])
        return self._fixed[term]

    def _hysteresis(
        self, values: Mapping[str, float], way: NDArray[np.float64], span: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        cycle = _limit_cycle(values[SIGMA], values.get(EXPONENT, 1.0))
        return self.direction * cycle.along(values[RHO] * way, values[RHO] * span)

    def _contact(
        self,
        values: Mapping[str, float],
        terms: Terms,
        stretch: NDArray[np.float64],
        way: NDArray[np.float64],
        gaps: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Slopes by the terms while one of the contacts carries, (n_points, n_terms)."""
        columns = np.zeros((len(stretch), len(terms)))
        for j, term in enumerate(terms):
            if term == FORCE:
                columns[:, j] = self._hysteresis(values, way, self.span - gaps)
            elif term == DAMPING:
                columns[:, j] = self.velocity
            elif term in _POWERS:
                columns[:, j] = stretch ** _POWERS[term]
        return columns

    def _held(
        self, gaps: NDArray[np.float64], before: NDArray[np.bool_], after: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Stretch of the isolator: in the play it stays where the contact was lost."""
        half = 0.5 * self.direction * gaps
        u = np.where(before, self.x + half, self.x - half)
        for part in self.parts:
            idle = ~(before[part] | after[part])
            if idle.any() and not idle.all():
                known, at = np.flatnonzero(~idle), np.flatnonzero(idle)
                inside = u[part]
                inside[at] = inside[known[np.searchsorted(known, at) - 1]]
        return u

    def _relaxation(self, time: float) -> NDArray[np.float64]:
        # Linear, so each harmonic of the displacement has its closed-form factor jωτ/(1 + jωτ).
        found = np.empty(len(self.x))
        for loop, part, basis in zip(self.loops, self.parts, self._bases, strict=True):
            series, count = loop.series, len(loop.series) // 2
            jwt = 2j * np.pi * loop.frequency_hz * time * np.arange(1, count + 1)
            harmonics = (series[1 : count + 1] - 1j * series[count + 1 :]) * jwt / (1 + jwt)
            found[part] = basis @ np.concatenate([[0.0], harmonics.real, -harmonics.imag])
        return found

    @cached_property
    def _bases(self) -> list[NDArray[np.float64]]:
        return [fourier(loop.phase, len(loop.series) // 2) for loop in self.loops]

    def _relaxed(self, stretch: NDArray[np.float64], time: float) -> NDArray[np.float64]:
        """Force of a Maxwell branch of stiffness 1 N/m along periodic stretches: stretch less that of its damper."""
        found = np.empty(len(stretch))
        order = np.arange(1, _HARMONICS + 1)
        for loop, part, (basis, inverse) in zip(self.loops, self.parts, self._harmonics, strict=True):
            series = inverse @ stretch[part]
            late = (series[1 : _HARMONICS + 1] - 1j * series[_HARMONICS + 1 :]) / (
                1 + 2j * np.pi * time * loop.frequency_hz * order
            )
            found[part] = stretch[part] - basis @ np.concatenate([series[:1], late.real, -late.imag])
        return found

    @cached_property
    def _harmonics(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Fourier series at each loop's points, and its least-squares inverse."""
        bases = [fourier(loop.phase, _HARMONICS) for loop in self.loops]
        return [(basis, np.asarray(np.linalg.pinv(basis), dtype=np.float64)) for basis in bases]


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
