"""Least squares on whole loops: any set of effects, all loops together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.loops.effects import NEVER_NEGATIVE, Structure
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.model import (
    EXPONENT,
    FORCE,
    GAP,
    GAPS,
    RHO,
    SIGMA,
    SPRING_GAP,
    STIFFNESS,
    TIME,
)
from ema_pipeline.loops.types import Loop

RANGES: Mapping[str, tuple[float, float]] = {
    RHO: (0.02, 200.0),
    SIGMA: (0.02, 5.0),
    EXPONENT: (1.0, 20.0),
    TIME: (0.3, 100.0),
    GAP: (0.0, 0.95),
    SPRING_GAP: (0.0, 0.95),
}
"""Of ρ·X for the largest loop, σ, n, τ·ω, and of the play over the way of the smallest loop. A Maxwell branch that
relaxes much faster than the motion is a viscous damper, and is left to be called one."""
_STARTS: Mapping[str, tuple[float, ...]] = {
    RHO: (0.2, 0.6, 2.0, 6.0, 30.0),
    SIGMA: (0.2, 0.5, 1.0),
    EXPONENT: (1.0, 1.0, 3.0),
    TIME: (0.5, 1.0, 2.0, 10.0),
    GAP: (0.02, 0.08, 0.2, 0.45),
    SPRING_GAP: (0.02, 0.08, 0.2, 0.45),
}
_TOGETHER = ((RHO, SIGMA), (EXPONENT,), (TIME,), GAPS)
SYSTEMATIC = 1.3
"""Mean square of the residuals, in variances of the noise, from which a model's misfit is not noise."""
_TRIED = 2
_ACTIVE_SETS = 3


@dataclass(frozen=True)
class Fitted:
    """A structure fitted to loops.

    Attributes
    ----------
    structure : Structure
    values : dict of str to float
        Parameters by the names of `ema_pipeline.loops.model`.
    scales : ndarray, (n_loops,)
        Factors on the model's force; ones unless the loops have scales of their own.
    residual : ndarray, (n_points,)
        Whitened, model - measured.
    jacobian : ndarray, (n_points, n_parameters)
        Of the residual by `names`, the scales last.
    """

    structure: Structure
    values: dict[str, float]
    scales: NDArray[np.float64]
    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of the Jacobian's first columns."""
        return (*self.structure.terms, *self.structure.shapes)

    @property
    def chi2(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    def reordered(self, effects: tuple[str, ...]) -> Fitted:
        """The same fit with its effects named in another order."""
        structure = replace(self.structure, effects=effects)
        old, new = self.names, (*structure.terms, *structure.shapes)
        columns = [*(old.index(n) for n in new), *range(len(old), self.jacobian.shape[1])]
        return replace(self, structure=structure, jacobian=self.jacobian[:, columns])

    def covariance(self, widening: float = 1.0) -> NDArray[np.float64]:
        """Covariance of `names`, whose variances are `widening` times those of the noise, (n, n)."""
        size = np.linalg.norm(self.jacobian, axis=0)
        size[size == 0] = 1.0
        j = self.jacobian / size
        whole = widening * np.linalg.pinv(j.T @ j, rcond=1e-13) / np.outer(size, size)
        n = len(self.names)
        return np.asarray(whole[:n, :n])


def loop_set(loops: Sequence[Loop], structure: Structure, own_scale: bool = False) -> LoopSet:
    """Loops with the misfit that a rich structure leaves taken into account."""
    first = LoopSet(loops, own_scale)
    fitted = fit(first, structure, physical=False)
    reduced = fitted.chi2 / max(first.freedom - fitted.jacobian.shape[1], 1)
    return first if reduced < SYSTEMATIC else LoopSet(loops, own_scale, float(np.sqrt(reduced)))


def fit(
    loops: LoopSet,
    structure: Structure,
    start: Mapping[str, float] | None = None,
    *,
    physical: bool = True,
    grid: bool = True,
) -> Fitted:
    """Least-squares fit of a structure.

    Parameters
    ----------
    loops : LoopSet
    structure : Structure
    start : mapping of str to float, optional
        Parameters of a fit nearby; shapes that it lacks are sought on a grid.
    physical : bool
        Whether damper, hysteresis and relaxation are kept from becoming negative.
    grid : bool
        Whether all shapes are also sought on a grid where `start` has them.
    """
    best: Fitted | None = None
    for shape in _shapes(loops, structure, dict(start or {}), grid, physical):
        found = _refine(loops, structure, shape, physical)
        if best is None or found.chi2 < best.chi2:
            best = found
    assert best is not None
    return best


def predict(loops: LoopSet, fitted: Fitted) -> NDArray[np.float64]:
    """Whitened residuals of loops that a fit has not seen: only offsets (and own scales) are fitted, (n_points,)."""
    scales = _scales(loops, fitted.structure, fitted.values)
    return loops.evaluate(fitted.structure, fitted.values, scales)[0] - loops.data


def _scales(loops: LoopSet, structure: Structure, values: Mapping[str, float]) -> NDArray[np.float64]:
    """Best factors on the force of each loop; ones where the loops have no scales of their own."""
    ones = np.ones(len(loops.loops))
    if not loops.own_scale:
        return ones
    each = loops.evaluate(structure, values, ones)[2]
    size = np.sum(each**2, axis=0)
    size[size == 0] = 1.0
    return np.maximum(each.T @ loops.data / size, 1e-3)


def _shapes(
    loops: LoopSet, structure: Structure, start: Mapping[str, float], grid: bool, physical: bool
) -> list[dict[str, float]]:
    """Most promising values of the shapes: those given, and the best of a grid.

    The shapes of one effect are varied together, those of the others stay: a grid over all would take minutes.
    """
    names = structure.shapes
    begin = {n: start.get(n, _STARTS[n][len(_STARTS[n]) // 2] * loops.shape_unit(n)) for n in names}
    options = [begin]
    for together in _TOGETHER:
        group = [n for n in together if n in names]
        if group and (grid or any(n not in start for n in group)):
            mesh = np.meshgrid(*(_STARTS[n] for n in group), indexing="ij")
            for row in np.stack([m.ravel() for m in mesh], axis=1):
                sought = {n: float(v) * loops.shape_unit(n) for n, v in zip(group, row, strict=True)}
                options.append(begin | sought)
    if len(options) == 1:
        return options
    cost = [_linear(loops, structure, shape, physical)[1] for shape in options]
    return [options[i] for i in np.argsort(cost)[:_TRIED]]


def _linear(
    loops: LoopSet, structure: Structure, shape: Mapping[str, float], physical: bool
) -> tuple[dict[str, float], float]:
    """Best linear parameters for given shapes, and the sum of squares."""
    terms, scales = structure.terms, np.ones(len(loops.loops))
    if loops.own_scale:
        ranges = np.array([np.ptp(loop.force) for loop in loops.loops])
        scales = ranges / ranges[loops.reference]
    units = np.array([loops.units[t] for t in terms])
    low = np.array([0.0 if physical and t in NEVER_NEGATIVE else -np.inf for t in terms])
    values = {**shape, **dict.fromkeys(terms, 0.0), STIFFNESS: 0.5 * loops.units[STIFFNESS]}
    if FORCE in terms:
        values[FORCE] = loops.units[FORCE]
    cost = np.inf
    for _ in range(_ACTIVE_SETS if GAP in shape else 1):
        _, columns, _ = loops.evaluate(structure, values, scales)
        columns = columns * units
        p = np.linalg.lstsq(columns, loops.data, rcond=1e-12)[0]
        if np.any(p < low):
            free = (low, np.full(len(p), np.inf))
            p = scipy.optimize.lsq_linear(columns, loops.data, free, method="bvls").x
        values |= {t: float(v) for t, v in zip(terms, p * units, strict=True)}
        cost = float(np.sum((columns @ p - loops.data) ** 2))
    if GAP in shape:  # what the last contacts make of it
        cost = float(np.sum((loops.evaluate(structure, values, scales)[0] - loops.data) ** 2))
    return values, cost


class _Coordinates:
    """Parameters of a fit as one vector of numbers near one."""

    def __init__(self, loops: LoopSet, structure: Structure, physical: bool) -> None:
        self.loops, self.structure = loops, structure
        self.terms, self.shapes = structure.terms, structure.shapes
        self.free = [k for k in range(len(loops.loops)) if loops.own_scale and k != loops.reference]
        low = [0.0 if physical and t in NEVER_NEGATIVE else -np.inf for t in self.terms]
        high = [np.inf] * len(low)
        for name in self.shapes:
            ends = RANGES[name] if name in GAPS else np.log(RANGES[name])
            low.append(float(ends[0]))
            high.append(float(ends[1]))
        self.low = np.array(low + [1e-3] * len(self.free))
        self.high = np.array(high + [1e3] * len(self.free))

    def point(self, values: Mapping[str, float], scales: NDArray[np.float64]) -> NDArray[np.float64]:
        linear = [values[t] / self.loops.units[t] for t in self.terms]
        shapes = [self._inner(n, values[n] / self.loops.shape_unit(n)) for n in self.shapes]
        theta = np.array([*linear, *shapes, *scales[self.free]])
        room = np.where(np.isfinite(self.low) & np.isfinite(self.high), 1e-6 * (self.high - self.low), 0.0)
        return np.clip(theta, self.low + room, self.high - room)

    def read(self, theta: NDArray[np.float64]) -> tuple[dict[str, float], NDArray[np.float64]]:
        n, m = len(self.terms), len(self.shapes)
        values = {t: float(v) * self.loops.units[t] for t, v in zip(self.terms, theta[:n], strict=True)}
        for name, v in zip(self.shapes, theta[n : n + m], strict=True):
            values[name] = (float(v) if name in GAPS else float(np.exp(v))) * self.loops.shape_unit(name)
        scales = np.ones(len(self.loops.loops))
        scales[self.free] = theta[n + m :]
        return values, scales

    def by_value(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Slopes of the parameters by the coordinates."""
        shapes = [self.loops.shape_unit(n) if n in GAPS else values[n] for n in self.shapes]
        return np.array([*(self.loops.units[t] for t in self.terms), *shapes, *np.ones(len(self.free))])

    @staticmethod
    def _inner(name: str, value: float) -> float:
        return value if name in GAPS else float(np.log(max(value, 1e-12)))


def _refine(loops: LoopSet, structure: Structure, shape: Mapping[str, float], physical: bool) -> Fitted:
    """Least squares over all parameters at once."""
    frame = _Coordinates(loops, structure, physical)
    values, _ = _linear(loops, structure, shape, physical)
    scales = _scales(loops, structure, values)
    values |= {t: values[t] * scales[loops.reference] for t in structure.terms}
    scales = scales / scales[loops.reference]

    def left(theta: NDArray[np.float64]) -> NDArray[np.float64]:
        values, scales = frame.read(theta)
        return loops.evaluate(structure, values, scales)[0] - loops.data

    def slopes(theta: NDArray[np.float64]) -> NDArray[np.float64]:
        values, scales = frame.read(theta)
        force, columns, each = loops.evaluate(structure, values, scales)
        blocks = [columns * [loops.units[t] for t in frame.terms]]
        n = len(frame.terms)
        for k in range(n, n + len(frame.shapes)):
            step = 1e-5 if theta[k] + 1e-5 < frame.high[k] else -1e-5
            moved = theta.copy()
            moved[k] += step
            blocks.append(((left(moved) + loops.data - force) / step)[:, None])
        if frame.free:
            blocks.append(each[:, frame.free])
        return np.hstack(blocks)

    theta = frame.point(values, scales)
    if frame.shapes or frame.free:
        found = scipy.optimize.least_squares(
            left,
            theta,
            slopes,
            bounds=(frame.low, frame.high),
            x_scale="jac",
            xtol=1e-8,
            ftol=1e-7,
            max_nfev=40,
        )
        theta = found.x
    values, scales = frame.read(theta)
    return Fitted(structure, values, scales, left(theta), slopes(theta) / frame.by_value(values))
