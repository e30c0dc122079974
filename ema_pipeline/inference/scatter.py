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
    most : float
        Largest value, in units of the default. A model that needs more does not explain the data: without this bound
        its failure would be hidden as scatter.
    """

    name: str
    title: str
    default: float
    spread: float = 0.5
    wide: float = 0.0
    most: float = 2.5
    at_once: bool = False

    @property
    def start(self) -> float:
        """Where learning begins."""
        return max(self.wide, self.default) if self.spread else self.default


Descend = Callable[[Problem, Mapping[str, float], NDArray[np.float64]], Posterior]


def learn(
    problem: Problem, found: Posterior, scatters: Mapping[str, Scatter], *, rounds: int = 4, steps: int = 8
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
        learned = {name: _relaxed(found, scatters[name]) for name in found.scatters}
        found = descend(problem, learned, found.x, steps=steps)
    cost = sum(
        0.5 * (np.log(found.scatters[n] / s.default) / s.spread) ** 2
        for n, s in scatters.items()
        if s.spread and n in found.scatters
    )
    return replace(found, scatter_cost=float(cost))


def widened(found: Posterior, scatters: Mapping[str, Scatter]) -> dict[str, float]:
    """Root of the expected square of every scatter: what intervals must hold of how well a scatter is known.

    A scatter of unknowns is averaged over its own density, the fit being linear about the maximum: with three masses
    the data hardly tell how much masses scatter, and the maximum lies far below the mean. The logarithm of a scatter
    of n residuals has the variance 1/(2n + 1/spread²).

    References
    ----------
    H. Rue, S. Martino, N. Chopin, J. R. Stat. Soc. B 71 (2009) 319-392: hyper-parameters are averaged on a grid.
    """
    result = {}
    for name, now in found.scatters.items():
        scatter = scatters[name]
        if not scatter.spread:
            result[name] = now
        elif np.any(found.unknowns.governed(name)):
            result[name] = _root_mean_square(found, scatter)
        else:
            result[name] = now * float(np.exp(1 / (2 * determined(found, name) + scatter.spread**-2.0)))
    return result


_GRID = np.linspace(-3.0, 3.0, 25)
"""Logarithm of a scatter about its default, in units of its prior 1 σ."""


def _root_mean_square(found: Posterior, scatter: Scatter) -> float:
    logs = np.minimum(_GRID * scatter.spread, np.log(scatter.most))
    values = scatter.default * np.exp(logs)
    density = np.array([found.log_evidence_at(scatter.name, v) for v in values]) - 0.5 * _GRID**2
    weight = np.exp(density - np.max(density))
    return float(np.sqrt(np.sum(weight * values**2) / np.sum(weight)))


def determined(found: Posterior, name: str) -> float:
    """Number of unknowns and residuals that determine a scatter, each by the share that the data hold of it."""
    governed = found.unknowns.governed(name)
    told = float(np.sum(1 - np.minimum(found.std[governed] / found.prior_std[governed], 1.0) ** 2))
    share = found.residuals.share.get(name)
    return told + (0.0 if share is None else float(np.sum(share)))


_RELAXATION = 1.5
"""Steps of expectation-maximisation are short where few parts are seen: longer ones converge to the same values."""


def _relaxed(found: Posterior, scatter: Scatter) -> float:
    now = found.scatters[scatter.name]
    if not scatter.spread:
        return now
    if scatter.at_once:
        return _of_residuals_at_once(found, scatter)
    step = _RELAXATION * np.log(_learned(found, scatter) / now)
    return float(min(now * np.exp(step), scatter.most * scatter.default))


def _learned(found: Posterior, scatter: Scatter) -> float:
    """One step of expectation-maximisation for one scatter."""
    now = found.scatters[scatter.name]
    squares, count = _of_unknowns(found, scatter.name, now)
    more, number = _of_residuals(found, scatter.name, now)
    return _mode_of_log(squares + more, count + number, now, scatter)


def _of_unknowns(found: Posterior, name: str, now: float) -> tuple[float, int]:
    """Expected sum of squares of the unknowns that the scatter governs, in units of their own factor."""
    governed = found.unknowns.governed(name)
    if not np.any(governed):
        return 0.0, 0
    x, variance = found.x[governed], np.diag(found.covariance)[governed]
    return float(np.sum((x**2 + variance) / found.unknowns.std[governed] ** 2)), int(np.sum(governed))


def _of_residuals(found: Posterior, name: str, now: float) -> tuple[float, int]:
    """Expected sum of squares of the discrepancies that the scatter adds to residuals.

    A residual e = discrepancy + noise has the discrepancy's mean `share`·e and variance σ²·share·(1 - share).
    """
    share = found.residuals.share.get(name)
    if share is None or not np.any(share > 0):
        return 0.0, 0
    rows = share > 0
    part = share[rows]
    return float(now**2 * np.sum(part * found.expected_squares(rows) + 1.0 - part)), int(np.sum(rows))


def _mode_of_log(squares: float, count: int, now: float, scatter: Scatter) -> float:
    """Scatter that maximises its expected log density, by Newton's method in its logarithm."""
    if count == 0:
        return scatter.default
    log, weight = np.log(now), scatter.spread**-2.0
    for _ in range(_NEWTON_STEPS):
        excess = squares / np.exp(2 * log)
        slope = -count + excess - (log - np.log(scatter.default)) * weight
        log -= float(np.clip(slope / (-2 * excess - weight), -0.5, 0.5))
    return float(np.exp(min(log, np.log(scatter.most * scatter.default))))


def _of_residuals_at_once(found: Posterior, scatter: Scatter) -> float:
    """Scatter that maximises the expected log density of the residuals, the unknowns being what is averaged over.

    With t = (scatter/now)², a residual's variance is 1 - share + share·t times what it is now.
    """
    now = found.scatters[scatter.name]
    share = found.residuals.share.get(scatter.name)
    if share is None:
        return now
    rows = share > 0  # the others do not depend on it
    share, square = share[rows], found.expected_squares(rows)
    log, weight = 0.0, scatter.spread**-2.0
    for _ in range(_NEWTON_STEPS):
        t = np.exp(2 * log)
        variance = 1 - share + share * t
        moved, excess = share * t / variance, square / variance
        slope = float(np.sum(moved * (excess - 1))) - (log + np.log(now / scatter.default)) * weight
        # Where the density is not concave in the logarithm, its expected curvature serves.
        log += float(np.clip(slope / (weight + 2 * np.sum(moved**2 * np.maximum(excess, 1.0))), -1.0, 1.0))
    return float(min(now * np.exp(log), scatter.most * scatter.default))
