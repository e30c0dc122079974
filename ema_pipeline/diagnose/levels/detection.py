"""What these hits would show: the least size of every effect that depends on the level that would be claimed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, prior_probabilities
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, prior_width, size_grid
from ema_pipeline.diagnose.levels.problem import NoiseFloor, TimeProblem, Whitening, linearised, residuals
from ema_pipeline.diagnose.types import DetectionLimit
from ema_pipeline.effects.base import EffectParameter
from ema_pipeline.errors import EmaError

_NINE_IN_TEN = 1.2816
"""Ninety per cent of a normal distribution lie above its mean less this many standard deviations."""

_PER_DECADE = 2


def detection_limits(
    case: LevelCase, hypotheses: Sequence[Hypothesis], last: Simulated, floor: NoiseFloor
) -> tuple[DetectionLimit, ...]:
    """The detection limit of every effect in hypotheses, for the rig that the last model found.

    A size is seen where it changes the simulated hits by more than other values of the rig's parameters make good:
    by as many standard uncertainties as a claim needs and 1.28 more. Of both signs the larger limit counts. Where the
    null is infinite (the preload of a mesh) the limit is the largest size that shows.

    Parameters
    ----------
    case : LevelCase
    hypotheses : sequence of Hypothesis
        Each adds one effect to the same base model.
    last : Simulated
    floor : NoiseFloor

    Returns
    -------
    tuple of DetectionLimit
        `size` is infinite (0 for an infinite null) where no size would be seen.
    """
    coarse = case.coarse()
    weights = coarse.weights(floor)
    prior = prior_probabilities(list(hypotheses), case.settings.null_prior, case.settings.parameter_prior)
    odds = case.settings.probability_least / (1 - case.settings.probability_least)
    found: list[DetectionLimit] = []
    if not hypotheses:
        return ()
    rest = _Rest(coarse.problem(Hypothesis(hypotheses[0].labels[:-1])), weights, last)
    for h in hypotheses:
        first = case.parameters_of(h.labels[-1])[0]
        believed = 2 * np.log(odds * prior[NOTHING] / max(prior[h.label], 1e-300))
        needed = _needed(case.settings.levels.gain_least, believed, prior_width(first))
        problem = coarse.problem(h)
        name = f"{h.labels[-1]}.{first.name}"
        limits = [_first_seen(s, rest.gains(problem, name, s), needed) for s in _sizes(first)]
        size = min(limits) if np.isinf(first.null) else max(limits)
        found.append(DetectionLimit(h.labels[-1], first.name, size, first.unit))
    return tuple(found)


def _needed(gain_least: float, believed: float, width: float) -> float:
    """Gain that nine in ten tests need: a size known to one part in √gain has Occam's factor width·√gain/√2π."""
    gain = gain_least
    for _ in range(5):
        gain = max(gain_least, believed + 2 * np.log(max(width * np.sqrt(gain / (2 * np.pi)), 1.0)))
    return float((np.sqrt(gain) + _NINE_IN_TEN) ** 2)


def _sizes(p: EffectParameter) -> list[NDArray[np.float64]]:
    """Sizes of each sign, from the least effect to the greatest."""
    grid = size_grid(p, _PER_DECADE)
    signs = [np.sort(np.abs(grid[grid * s > 0])) * s for s in (1, -1)]
    return [s[::-1] if np.isinf(p.null) else s for s in signs if s.size]


class _Rest:
    """The model without the effect, and what other values of its parameters can make good."""

    def __init__(self, problem: TimeProblem, weights: Sequence[Whitening], last: Simulated) -> None:
        self.weights, self.values = weights, last.values
        x = problem.space.point(last.values)
        self.residual, self.jacobian = linearised(problem, weights, x)
        prior = problem.space.has_prior.astype(float)
        self.normal = self.jacobian @ self.jacobian.T + np.diag(prior + 1e-9)

    def gains(self, problem: TimeProblem, name: str, sizes: NDArray[np.float64]) -> Iterator[float]:
        """Expected fall of the objective for true sizes; infinite where the motion has no solution."""
        for size in sizes:
            point = problem.space.point({**self.values, name: float(size)})
            try:
                d = residuals(problem, self.weights, point[None])[0] - self.residual
            except EmaError:
                yield float("inf")
                continue
            along = self.jacobian @ d
            yield float(d @ d - along @ np.linalg.solve(self.normal, along))


def _first_seen(sizes: NDArray[np.float64], gains: Iterator[float], needed: float) -> float:
    """Where the gain first reaches what is needed, between sizes by a power law."""
    before, lower = 0.0, 0.0
    for size, gain in zip(np.abs(sizes), gains, strict=True):
        if gain >= needed:
            if not (np.isfinite(gain) and before > 0):
                return float(size)
            share = np.log(needed / before) / np.log(gain / before)
            return float(lower * (size / lower) ** share)
        before, lower = gain, float(size)
    return float("inf") if sizes[-1] ** 2 > sizes[0] ** 2 else 0.0
