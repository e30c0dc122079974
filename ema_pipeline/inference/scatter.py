"""Hyper-parameters: how much parts, channels, damping and the model itself scatter, learned from the data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.maximise import descend
from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import Problem

_NEWTON_STEPS = 20


@dataclass(frozen=True)
class Scatter:
    """A hyper-parameter: a standard deviation of which only the order of magnitude is known.

    Attributes
    ----------
    name, title : str
        Its name, and what it is in the words of a report.
    default : float
        Median of its log-normal prior: what was stated, or what such rigs have.
    spread : float
        1 σ of its logarithm; 0 for a scatter that is known.
    wide : float
        Value from which learning begins. Begun too narrow, a fit takes scatter for effects.
    """

    name: str
    title: str
    default: float
    spread: float = 0.5
    wide: float = 0.0

    @property
    def start(self) -> float:
        """Where learning begins."""
        return max(self.wide, self.default) if self.spread else self.default


Descend = Callable[[Problem, Mapping[str, float], NDArray[np.float64]], Posterior]


def learn(
    problem: Problem, found: Posterior, scatters: Mapping[str, Scatter], *, rounds: int = 3, steps: int = 8
) -> Posterior:
    """Learn the scatters by expectation-maximisation, each with its log-normal prior, and the fit with them.

    Parameters
    ----------
    problem : Problem
    found : Posterior
        Where to begin.
    scatters : dict of str to Scatter
    rounds, steps : int
        Rounds of learning, and most steps of the fit after each.
    """
    for _ in range(rounds):
        learned = {name: _learned(found, scatters[name]) for name in found.scatters}
        found = descend(problem, learned, found.x, steps=steps)
    cost = sum(
        0.5 * (np.log(found.scatters[n] / s.default) / s.spread) ** 2
        for n, s in scatters.items()
        if s.spread and n in found.scatters
    )
    return replace(found, scatter_cost=float(cost))


def _learned(found: Posterior, scatter: Scatter) -> float:
    """One step of expectation-maximisation for one scatter; the unknowns are what is averaged over."""
    now = found.scatters[scatter.name]
    if not scatter.spread:
        return now
    squares, count = _of_unknowns(found, scatter.name, now)
    part, square = _of_residuals(found, scatter.name)
    if count == 0 and len(part) == 0:
        return scatter.default
    return _mode_of_log(squares / now**2, count, part, square, now, scatter)


def _of_unknowns(found: Posterior, name: str, now: float) -> tuple[float, int]:
    """Expected sum of squares of the unknowns that the scatter governs, in units of their own factor."""
    governed = found.unknowns.governed(name)
    if not np.any(governed):
        return 0.0, 0
    x, variance = found.x[governed], np.diag(found.covariance)[governed]
    return float(np.sum((x**2 + variance) / found.unknowns.std[governed] ** 2)), int(np.sum(governed))


def _of_residuals(found: Posterior, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Share of the scatter in the variance of every residual that has one, and the residual's expected square."""
    share = found.residuals.share.get(name)
    if share is None or not np.any(share > 0):
        return np.zeros(0), np.zeros(0)
    rows = share > 0
    jacobian = found.residuals.jacobian[rows]
    uncertain = np.einsum("ij,jk,ik->i", jacobian, found.covariance, jacobian)
    return share[rows], found.residuals.values[rows] ** 2 + uncertain


def _mode_of_log(
    squares: float,
    count: int,
    part: NDArray[np.float64],
    square: NDArray[np.float64],
    now: float,
    scatter: Scatter,
) -> float:
    """Scatter that maximises its expected log density, by Newton's method in its logarithm.

    With t = (scatter/now)², a residual's variance becomes 1 - part + part·t times what it is, and the sum of squares
    of the unknowns that it governs `squares`/t.
    """
    log, weight = np.log(now), scatter.spread**-2.0
    for _ in range(_NEWTON_STEPS):
        t = np.exp(2 * (log - np.log(now)))
        variance = 1 - part + part * t
        moved, excess = part * t / variance, square / variance
        slope = -count + squares / t + float(np.sum(moved * (excess - 1)))
        slope -= (log - np.log(scatter.default)) * weight
        # Where the density is not concave in the logarithm, the expected curvature serves.
        curvature = 2 * squares / t + weight + 2 * float(np.sum(moved**2 * np.maximum(excess, 1.0)))
        log += float(np.clip(slope / curvature, -0.5, 0.5))
    return float(np.exp(log))
