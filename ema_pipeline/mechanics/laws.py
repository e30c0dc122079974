"""Nonlinear elements: a linear tangent, which the matrices hold, and the force's deviation from it.

Each acts along a row like the linear elements do. Its state after a step follows from its stretch, so that an
integrator only has to find the stretches. Deviations are evaluated one number at a time: an integrator asks
for a few of them per step, where plain floats are faster than arrays.

References
----------
F. Ikhouane, J. Rodellar, *Systems with Hysteresis: Analysis, Identification and Control using the Bouc-Wen
Model*, 2007, chapter 2 (normalised form). For the describing functions: A. Gelb, W. E. Vander Velde,
*Multiple-Input Describing Functions and Nonlinear System Design*, 1968.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import cosh, exp, expm1, inf, log1p, tanh

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError

_SETTLING = 400

Row = Mapping[str, float]
Step = tuple[float, float, float, float]
"""Deviation of the force, N; its derivatives by stretch and by rate; the state after the step."""


@dataclass(frozen=True)
class Spring:
    """Elastic energy ½·stiffness·(row·x)²; N/m. `loss_factor` makes it stiffness·(1 + j·loss_factor).

    Springs of one `part` deviate from the drawing together; those of one `piece` mostly, as directions of a bearing.
    """

    name: str
    row: Row
    stiffness: float
    loss_factor: float = 0.0
    part: str = ""
    piece: str = ""


class Nonlinear:
    """What every nonlinear element offers.

    `tangent_stiffness` and `tangent_damping` are the slopes of its force that the linear system holds;
    `start` is the state at rest.
    """

    start = 0.0
    name: str
    row: Row

    @property
    def tangent_stiffness(self) -> float:
        """N/m."""
        return 0.0

    @property
    def tangent_damping(self) -> float:
        """N·s/m."""
        return 0.0

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """Deviation of the force from its tangent after a straight path from `before` to `stretch`, m."""
        raise NotImplementedError

    @property
    def law(self) -> tuple[int, float, float, float] | None:
        """Which of `LAWS` gives the force, and its three numbers; None for an element with a law of its own."""
        return None

    def settled(self, path: Sequence[float], time_step: float) -> float:
        """State at the end of a period, `path`, that has been run through for ever."""
        return self.start

    def along(
        self,
        path: NDArray[np.float64],
        rates: NDArray[np.float64],
        time_step: float,
        before: float,
        state: float,
    ) -> NDArray[np.float64]:
        """Deviation of the force at points of a path that comes from `before` in `state`, (n_points,)."""
        result = [0.0] * len(path)
        for k, (stretch, rate) in enumerate(zip(path.tolist(), rates.tolist(), strict=True)):
            result[k], _fd, _fv, state = self.step(before, stretch, rate, state, time_step)
            before = stretch
        return np.array(result)


Law = tuple[float, float, float]
"""Deviation of the force, N, and its derivatives by stretch and by rate."""


def polynomial(stretch: float, rate: float, quadratic: float, cubic: float, unused: float) -> Law:
    """Force of a `PolynomialSpring`."""
    force = (quadratic + cubic * stretch) * stretch * stretch
    return force, (2 * quadratic + 3 * cubic * stretch) * stretch, 0.0


def friction(stretch: float, rate: float, limit: float, velocity: float, unused: float) -> Law:
    """Force of `DryFriction`."""
    x = rate / velocity
    slope = 0.0 if abs(x) > 300 else limit / (velocity * cosh(x) ** 2)
    return limit * tanh(x), 0.0, slope


def parting(stretch: float, rate: float, k: float, preload: float, gap: float) -> Law:
    """Deviation of a `PartingSpring` from its stiffness in contact."""
    if preload == inf:
        return 0.0, 0.0, 0.0
    contact = stretch + preload
    rest = 0.0 if preload > 0 else -k * preload  # the tangent's force is counted from contact
    if contact >= 0:
        return -rest, 0.0, 0.0
    if contact >= -gap:
        return -k * contact - rest, -k, 0.0
    return k * gap - rest, 0.0, 0.0


LAWS = (polynomial, friction, parting)
"""Laws without memory, which `mechanics.modal_response_kernel` and `mechanics.equivalent_kernel` compile."""
POLYNOMIAL, FRICTION, PARTING = range(len(LAWS))
AT_LARGER_MOTION = ((1, 2, 0), (-1, -1, 0), (0, -1, -1))
"""Of each law, powers of a factor by which its three numbers change where it does the same, over the motion, as with
all motions larger by that factor."""


@dataclass(frozen=True)
class PolynomialSpring(Nonlinear):
    """Force quadratic·δ² + cubic·δ³; N/m², N/m³. The linear term is a `Spring` beside it."""

    name: str
    row: Row
    quadratic: float = 0.0
    cubic: float = 0.0

    @property
    def law(self) -> tuple[int, float, float, float]:
        """See `Nonlinear.law`."""
        return 0, self.quadratic, self.cubic, 0.0

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`."""
        return *polynomial(stretch, rate, self.quadratic, self.cubic, 0.0), 0.0

    def along(
        self,
        path: NDArray[np.float64],
        rates: NDArray[np.float64],
        time_step: float,
        before: float,
        state: float,
    ) -> NDArray[np.float64]:
        """See `Nonlinear.along`."""
        return (self.quadratic + self.cubic * path) * path**2


@dataclass(frozen=True)
class DryFriction(Nonlinear):
    """Coulomb force limit·tanh(δ̇/velocity).

    The sign function is regularised: below `velocity`, m/s, the element acts like a viscous damper of
    limit/velocity, so it creeps where true friction sticks. The compiled loop takes a `velocity` no finer than
    its steps resolve. It gives nothing to the linear system: its
    equivalent damper 4·limit/(π·ω·amplitude) vanishes for large motions, and that limit is the base model.
    """

    name: str
    row: Row
    limit: float
    velocity: float = 1e-3

    @property
    def law(self) -> tuple[int, float, float, float]:
        """See `Nonlinear.law`."""
        return 1, self.limit, self.velocity, 0.0

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`."""
        return *friction(stretch, rate, self.limit, self.velocity, 0.0), 0.0


@dataclass(frozen=True)
class PartingSpring(Spring, Nonlinear):
    """A gear mesh or any contact that can part.

    `preload` is the deflection of the contact at the working point, from which the stretch δ is counted:
    the teeth part where δ falls below -preload, and meet again with their backs after a further `gap`, m.
    The force counts from its value at the working point: k·max(δ + preload, 0) + k·min(δ + preload + gap, 0)
    - k·max(preload, 0). A negative preload is a working point inside the gap: -gap/2 is its middle, and the
    element is then the symmetric backlash function.
    """

    preload: float = inf
    gap: float = inf

    @property
    def law(self) -> tuple[int, float, float, float]:
        """See `Nonlinear.law`."""
        return 2, self.stiffness, self.preload, self.gap

    @property
    def tangent_stiffness(self) -> float:
        """Stiffness in contact, N/m."""
        return self.stiffness

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`."""
        return *parting(stretch, rate, self.stiffness, self.preload, self.gap), 0.0

    def along(
        self,
        path: NDArray[np.float64],
        rates: NDArray[np.float64],
        time_step: float,
        before: float,
        state: float,
    ) -> NDArray[np.float64]:
        """See `Nonlinear.along`."""
        if self.preload == inf:
            return np.zeros(len(path))
        parted = np.clip(-path - self.preload, 0.0, self.gap)
        return self.stiffness * (parted - max(-self.preload, 0.0))


@dataclass(frozen=True)
class LooseSpring(PartingSpring):
    """A spring with play in its middle position, which all elements along the same row share.

    Where the motion is prescribed (`ema_pipeline.mechanics.cycles`) the play is in series with everything along the
    row: no element of it acts until the play has been run through. In a time response only the spring parts.
    """


@dataclass(frozen=True)
class BoucWen(Nonlinear):
    """Normalised Bouc-Wen hysteresis: force limit·w, ẇ = ρ(δ̇ - σ|δ̇||w|ⁿ⁻¹w + (σ - 1)δ̇|w|ⁿ).

    Attributes
    ----------
    limit : float
        k_w, the limit of its force, N.
    rho : float
        1/m; limit·rho is the stiffness at small motions, which the linear system holds.
    sigma : float
        Shape of the unloading branch; the loop takes energy for sigma > 0 and is passive for any motion
        from 0.5 on.
    exponent : float
        n ≥ 1: the larger, the sharper the yield.

    Notes
    -----
    The force depends on the path only, not on its speed. For n = 1 each stretch of the path is solved in
    closed form; other exponents take a fourth-order step.
    """

    name: str
    row: Row
    limit: float
    rho: float
    sigma: float
    exponent: float = 1.0

    @property
    def tangent_stiffness(self) -> float:
        """Stiffness at small motions, N/m."""
        return self.limit * self.rho

    def slope(self, w: float, direction: float) -> float:
        """dw/dδ for motion in `direction` (±1), 1/m."""
        size = abs(w) ** self.exponent
        towards = direction if w >= 0 else -direction
        return self.rho * (1.0 - (self.sigma * towards + 1.0 - self.sigma) * size)

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`."""
        path = stretch - before
        direction = 1.0 if path >= 0 else -1.0
        w = self._after(state, path)
        slope = self.limit * self.slope(w, direction) - self.tangent_stiffness
        return self.limit * w - self.tangent_stiffness * stretch, slope, 0.0, w

    def settled(self, path: Sequence[float], time_step: float) -> float:
        """See `Nonlinear.settled`: only the turning points count."""
        turns = _turning_points(path)
        w, before = self.start, path[-1]
        for _ in range(_SETTLING):
            begun = w
            for stretch in turns:
                w = self._after(w, stretch - before)
                before = stretch
            if abs(w - begun) < 1e-13:
                break
        return w

    def along(
        self,
        path: NDArray[np.float64],
        rates: NDArray[np.float64],
        time_step: float,
        before: float,
        state: float,
    ) -> NDArray[np.float64]:
        """See `Nonlinear.along`: in closed form from one turning point to the next."""
        if self.exponent != 1.0:
            return super().along(path, rates, time_step, before, state)
        w = np.empty(len(path))
        steps = np.sign(np.diff(path, prepend=before))
        cuts = np.flatnonzero(np.diff(steps)) + 1
        for start, stop in pairwise([0, *cuts.tolist(), len(path)]):
            branch = path[start:stop] - before
            w[start:stop] = self._branch(state, branch, -1.0 if branch[-1] < 0 else 1.0)
            before, state = float(path[stop - 1]), float(w[stop - 1])
        return self.limit * w - self.tangent_stiffness * path

    def _branch(self, w: float, path: NDArray[np.float64], direction: float) -> NDArray[np.float64]:
        """w after ways `path` in one direction from a place where it was `w`."""
        if w * direction >= 0:
            return _exponential(w, direction, self.rho * path)
        a = -direction * (1.0 - 2 * self.sigma)
        crossing = log1p(-a * w) / a if abs(a) > 1e-12 else -w
        x = self.rho * path
        late = np.abs(x) >= abs(crossing)
        result = np.empty(len(path))
        result[~late] = _exponential(w, a, x[~late])
        result[late] = _exponential(0.0, direction, x[late] - crossing)
        return result

    def _after(self, w: float, path: float) -> float:
        return self._closed(w, path) if self.exponent == 1.0 else self._runge_kutta(w, path)

    def _closed(self, w: float, path: float) -> float:
        """dw/dδ = ρ(1 - a·w) with a constant between changes of sign of w."""
        direction = 1.0 if path >= 0 else -1.0
        while True:
            away = w * direction >= 0
            # a carries the sign of w, so that a·w = (…)|w|.
            size = 1.0 if away else 1.0 - 2 * self.sigma
            a = size * (direction if away else -direction)
            if not away:
                crossing = (log1p(-a * w) / a if abs(a) > 1e-12 else -w) / self.rho
                if abs(crossing) < abs(path):
                    w, path = 0.0, path - crossing
                    continue
            x = self.rho * path
            if abs(a) <= 1e-12:
                return w + x
            return w * exp(-a * x) - expm1(-a * x) / a

    def _runge_kutta(self, w: float, path: float) -> float:
        direction = 1.0 if path >= 0 else -1.0
        count = 1 + int(4 * self.rho * abs(path))
        h = path / count
        for _ in range(count):
            a = self.slope(w, direction)
            b = self.slope(w + 0.5 * h * a, direction)
            c = self.slope(w + 0.5 * h * b, direction)
            w += h / 6 * (a + 2 * b + 2 * c + self.slope(w + h * c, direction))
        return w


@dataclass(frozen=True)
class Maxwell(Nonlinear):
    """Relaxation: a spring `stiffness` in series with a damper, which follows with `time` (c/k), s.

    Its loss per cycle π·k·X²·ωτ/(1 + ω²τ²) falls with frequency above 1/(2πτ). The linear system holds the
    spring alone, i.e. motions faster than `time`; time and harmonic responses are exact.
    """

    name: str
    row: Row
    stiffness: float
    time: float

    @property
    def tangent_stiffness(self) -> float:
        """Stiffness to motions faster than `time`, N/m."""
        return self.stiffness

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`; the state is the stretch of the damper."""
        x = time_step / self.time
        decay = exp(-x)
        late = -expm1(-x) / x  # mean of e^{-s} over the step
        after = decay * state + (late - decay) * before + (1.0 - late) * stretch
        return -self.stiffness * after, -self.stiffness * (1.0 - late), 0.0, after

    def settled(self, path: Sequence[float], time_step: float) -> float:
        """See `Nonlinear.settled`: what is left of the start dies out as exp(-t/time)."""
        state, before = 0.0, path[-1]
        for stretch in path:
            state = self.step(before, stretch, 0.0, state, time_step)[3]
            before = stretch
        return state / -expm1(-len(path) * time_step / self.time)


def _exponential(w: float, a: float, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution of dw/dx = 1 - a·w from w at x = 0."""
    if abs(a) <= 1e-12:
        return w + x
    return np.asarray(w * np.exp(-a * x) - np.expm1(-a * x) / a)


def _turning_points(path: Sequence[float]) -> list[float]:
    """Places where the path turns, and its last one."""
    turns = [b for a, b, c in zip([path[-1], *path], path, path[1:], strict=False) if (b - a) * (c - b) <= 0]
    return [*turns, path[-1]]


def check_element(element: Nonlinear) -> None:
    """EmaError for values that make no physical sense."""
    if isinstance(element, BoucWen) and (element.rho <= 0 or element.exponent < 1):
        raise EmaError(f"'{element.name}': a Bouc-Wen element needs rho > 0 and exponent ≥ 1")
    if isinstance(element, Maxwell) and element.time <= 0:
        raise EmaError(f"'{element.name}': a relaxation needs a time above 0 s")
    if isinstance(element, DryFriction) and element.velocity <= 0:
        raise EmaError(f"'{element.name}': dry friction needs a regularisation velocity above 0 m/s")
    if isinstance(element, PartingSpring) and element.gap < 0:
        raise EmaError(f"'{element.name}': the gap behind the teeth cannot be negative")
