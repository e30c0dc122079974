"""Hyper-parameters: how much parts, channels, damping and the model itself scatter, learned from the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from ema_pipeline.inference import tails
from ema_pipeline.inference.factor import lower_factor, solve_lower
from ema_pipeline.inference.maximise import descend
from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import Problem, in_blocks


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
    least : float
        Smallest value, in units of the default. Most shapes of a test may agree better than any model is, by which the
        few that do not are outliers all the more.
    """

    name: str
    title: str
    default: float
    spread: float = 0.5
    wide: float = 0.0
    most: float = 2.5
    least: float = 0.0

    @property
    def start(self) -> float:
        """Where learning begins."""
        return max(self.wide, self.default) if self.spread else self.default


class LinearEvidence:
    """Log evidence as a function of the scatters of unknowns, the residuals being linear about a maximum.

    Parameters
    ----------
    found : Posterior
    """

    def __init__(self, found: Posterior) -> None:
        values, jacobian = found.residuals.weighted
        self.unknowns, self.scatters = found.unknowns, found.scatters
        self.curvature = jacobian.T @ jacobian
        self.pull = self.curvature @ found.x - jacobian.T @ values

    def at(self, scatters: Mapping[str, float]) -> float:
        """Log evidence with some scatters at other values; less a constant."""
        std = self.unknowns.prior_std({**self.scatters, **scatters})
        factor = lower_factor(np.eye(len(std)) + std[:, None] * self.curvature * std)
        explained = solve_lower(factor, std * self.pull)
        return 0.5 * float(explained @ explained) - float(np.sum(np.log(np.diag(factor))))


class ExpectedDensity:
    """Log density of the residuals as a function of their scatters, averaged over unknowns as uncertain as they are.

    Parameters
    ----------
    found : Posterior
    """

    def __init__(self, found: Posterior) -> None:
        self.scatters, self.share, self.block = found.scatters, found.residuals.share, found.residuals.block
        self.squares = found.expected_squares(weighted=False)

    def at(self, scatters: Mapping[str, float]) -> float:
        """Log density with some scatters at other values; less a constant."""
        variance = np.ones(len(self.squares))
        for name, share in self.share.items():
            variance += share * ((scatters.get(name, self.scatters[name]) / self.scatters[name]) ** 2 - 1)
        squares = self.squares / variance
        alone = squares if self.block is None else squares[self.block < 0]
        together = tails.cost(*in_blocks(squares, self.block))
        return -0.5 * float(np.sum(np.log(variance))) - 0.5 * float(np.sum(alone)) - float(np.sum(together))


def learn(
    problem: Problem, found: Posterior, scatters: Mapping[str, Scatter], *, rounds: int = 10, steps: int = 8
) -> Posterior:
    """Learn the scatters, each with its log-normal prior, and the fit with them.

    In every round each scatter is led to the largest density beside the others, that of the data for scatters of
    unknowns, that of the residuals for theirs, and the fit follows.

    Parameters
    ----------
    problem : Problem
    found : Posterior
        Where to begin.
    scatters : dict of str to Scatter
    rounds, steps : int
        Most rounds of learning, and most steps of the fit after each.
    """
    found = replace(found, scatter_cost=_cost(found, scatters))
    if not np.isfinite(found.cost):  # nothing is learned of a model without an answer
        return found
    for _ in range(rounds):
        further = _further(problem, found, _learned(found, scatters), scatters, steps)
        if further is None:
            break
        gained = further.log_evidence - found.log_evidence
        found = further
        if gained < _SETTLED:
            break
    return found


def _further(
    problem: Problem,
    found: Posterior,
    learned: Mapping[str, float],
    scatters: Mapping[str, Scatter],
    steps: int,
) -> Posterior | None:
    """The fit at learned scatters, or nearer to those before where that is worse; None where nothing is better."""
    for share in _SHARES:
        tried = {name: now * (learned[name] / now) ** share for name, now in found.scatters.items()}
        further = descend(problem, tried, found.x, steps=steps)
        further = replace(further, scatter_cost=_cost(further, scatters))
        if further.log_evidence > found.log_evidence:
            return further
    return None


_SHARES = (1.0, 0.4, 0.1)
"""Shares of the way to what was learned that are tried: scatters that depend on each other may all go too far."""


def _cost(found: Posterior, scatters: Mapping[str, Scatter]) -> float:
    known = [(now, scatters[name]) for name, now in found.scatters.items() if scatters[name].spread]
    return float(sum(0.5 * (np.log(now / s.default) / s.spread) ** 2 for now, s in known))


_SETTLED = 0.1
"""Log evidence gained in one round below which nothing more is learned."""
_FURTHER = 1.5
"""Factor on the step of a scatter of residuals that shrinks, which is too short while unknowns can follow it."""
_FURTHEST = 1.5
"""Largest change of the logarithm of a scatter in one round: the fit is linear about its maximum for about as far."""
_NEAR = 0.01
"""Relative accuracy of a scatter."""


def _learned(found: Posterior, scatters: Mapping[str, Scatter]) -> dict[str, float]:
    """All scatters after one round, each where the density is largest beside those before it."""
    of_unknowns, of_residuals = LinearEvidence(found), ExpectedDensity(found)
    learned = dict(found.scatters)
    for name in found.scatters:
        scatter = scatters[name]
        if not scatter.spread:
            continue
        if name in found.unknowns.scatter:
            learned[name] = _best(of_unknowns, learned, scatter)
        elif name in found.residuals.share:
            best = _best(of_residuals, learned, scatter)
            further = best * min(best / learned[name], 1.0) ** (_FURTHER - 1)
            learned[name] = max(further, scatter.least * scatter.default)
        else:
            learned[name] = scatter.default
    return learned


def _best(density: LinearEvidence | ExpectedDensity, known: Mapping[str, float], scatter: Scatter) -> float:
    here, most = float(np.log(known[scatter.name] / scatter.default)), float(np.log(scatter.most))
    least = float(np.log(scatter.least)) if scatter.least else -np.inf

    def cost(log: float) -> float:
        told = density.at({**known, scatter.name: scatter.default * np.exp(log)})
        return 0.5 * (log / scatter.spread) ** 2 - told

    bounds = max(min(here, most) - _FURTHEST, least), max(min(here + _FURTHEST, most), least + _NEAR)
    found = scipy.optimize.minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": _NEAR})
    return scatter.default * float(np.exp(found.x))


def widened(found: Posterior, scatters: Mapping[str, Scatter]) -> dict[str, float]:
    """Root of the expected square of every scatter: what intervals must hold of how well a scatter is known.

    A scatter of unknowns is averaged over its own density, the fit being linear about the maximum: with three masses
    the data hardly tell how much masses scatter, and the maximum lies far below the mean. The logarithm of a scatter
    of n residuals has the variance 1/(2n + 1/spread²).

    References
    ----------
    H. Rue, S. Martino, N. Chopin, J. R. Stat. Soc. B 71 (2009) 319-392: hyper-parameters are averaged on a grid.
    """
    result, evidence = {}, LinearEvidence(found)
    for name, now in found.scatters.items():
        scatter = scatters[name]
        if not scatter.spread:
            result[name] = now
        elif name in found.unknowns.scatter:
            result[name] = _root_mean_square(evidence, scatter)
        else:
            result[name] = now * float(np.exp(1 / (2 * determined(found, name) + scatter.spread**-2.0)))
    return result


_GRID = np.linspace(-3.0, 3.0, 25)
"""Logarithm of a scatter about its default, in units of its prior 1 σ."""


def _root_mean_square(evidence: LinearEvidence, scatter: Scatter) -> float:
    logs = np.minimum(_GRID * scatter.spread, np.log(scatter.most))
    values = scatter.default * np.exp(logs)
    density = np.array([evidence.at({scatter.name: v}) for v in values]) - 0.5 * _GRID**2
    weight = np.exp(density - np.max(density))
    return float(np.sqrt(np.sum(weight * values**2) / np.sum(weight)))


def determined(found: Posterior, name: str) -> float:
    """Number of unknowns and residuals that determine a scatter, each by the share that the data hold of it."""
    governed = found.unknowns.governed(name)
    told = float(np.sum(1 - np.minimum(found.std[governed] / found.prior_std[governed], 1.0) ** 2))
    share = found.residuals.share.get(name)
    return told + (0.0 if share is None else float(np.sum(share)))
