"""How well a model predicts what its fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.parallel import spread
from ema_pipeline.inference import Bounded, Posterior, Residuals, descend, lower_factor, solve_lower
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, part_reach, transferred

_STEPS = 20


@dataclass(frozen=True)
class HeldOut:
    """Prediction of all parts that were held out in turn.

    Attributes
    ----------
    error : float
        Root mean square of (measurement - prediction)/σ, σ with the uncertainty of the fit; about 1 where the model
        holds.
    log_density : float
        Natural logarithm of the predictive density, up to a constant of the data.
    """

    error: float
    log_density: float


NOTHING_HELD_OUT = HeldOut(float("nan"), float("nan"))


def held_out(observations: Observations, fit: Fit, processes: int | None = 1) -> HeldOut:
    """Fit to all but one part, predict that part, in turn; scatters as they are in `fit`.

    No part may lie further out than parts scatter: otherwise a part moved far from its prior would stand in for the
    effect and predict just as well. `processes` share the parts, None for one per processor.
    """
    most = part_reach(observations, fit.posterior)

    def told(fold: tuple[Observations, Observations]) -> tuple[float, int, float]:
        kept, out = fold
        problem, scatters = fit.model.problem(kept), fit.posterior.scatters
        start = transferred(fit.posterior, problem.unknowns, problem.start())
        return _predicted(out, fit, descend(Bounded(problem, most), scatters, start, steps=_STEPS))

    parts = list(spread(told, observations.folds(), processes))
    squares, count, density = (sum(of) for of in zip(*parts, strict=True)) if parts else (0.0, 0, 0.0)
    if not count:
        return NOTHING_HELD_OUT
    return HeldOut(float(np.sqrt(squares / count)), density)


def _predicted(out: Observations, fit: Fit, trained: Posterior) -> tuple[float, int, float]:
    """Sum of squares, its number of terms, and log density of one part."""
    problem = fit.model.problem(out)
    x = transferred(trained, problem.unknowns)
    found = problem.residuals(x, trained.scatters)
    if not np.all(np.isfinite(found.values)):
        return 0.0, 0, -np.inf
    prior = problem.unknowns.prior_std(trained.scatters)
    covariance = np.diag(prior**2)
    known = [trained.unknowns.index.get(n, -1) for n in problem.unknowns.names]
    at = np.array([i for i, k in enumerate(known) if k >= 0], int)
    to = np.array([k for k in known if k >= 0], int)
    covariance[np.ix_(at, at)] = trained.covariance[np.ix_(to, to)]
    count = max(len(found.values) - found.projected, 1)
    if found.block is not None:
        squares, cost = _in_blocks(found, covariance)
        return squares + 2 * found.penalty, count, -cost - found.log_scale - found.penalty
    squares, half_log_det = _marginal(found.values, found.jacobian, covariance)
    density = -0.5 * squares - half_log_det - found.log_scale - found.penalty
    if found.relative is not None:
        squares, _ = _marginal(found.stated, found.jacobian * found.relative[:, None], covariance)
    return squares + 2 * found.penalty, count, density


def _in_blocks(found: Residuals, covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Sum of squares in which errors count, and -log density, each value predicted from those before it."""
    spread = np.eye(len(found.values)) + found.jacobian @ covariance @ found.jacobian.T
    factor = lower_factor(spread)
    values = solve_lower(factor, found.values)
    whitened = Residuals(values, np.zeros((0, len(covariance))), block=found.block)
    return whitened.squares, whitened.cost + float(np.sum(np.log(np.diag(factor))))


def _marginal(
    values: NDArray[np.float64], jacobian: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[float, float]:
    """vᵀ(I + J C Jᵀ)⁻¹v and half the log determinant, by the smaller matrix of as many rows as unknowns."""
    size, directions = np.linalg.eigh(covariance)
    reach = jacobian @ (directions * np.sqrt(np.maximum(size, 0.0)))
    factor = lower_factor(np.eye(len(size)) + reach.T @ reach)
    taken = solve_lower(factor, reach.T @ values)
    return float(values @ values - taken @ taken), float(np.sum(np.log(np.diag(factor))))
