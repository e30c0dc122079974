"""How well a model predicts what its fit has not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import (
    Bounded,
    Posterior,
    Problem,
    Residuals,
    Unknowns,
    descend,
    lower_factor,
    solve_lower,
)
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, part_reach, transferred
from ema_pipeline.processes import spread

_STEPS = 20
_FOLLOWED = 6
"""Steps in which what is uncertain follows the data that are held out."""


@dataclass(frozen=True)
class HeldOut:
    """Prediction of all parts that were held out in turn.

    Attributes
    ----------
    error : float
        Root mean square of (measurement - prediction)/σ, σ with the uncertainty of the fit to first order; about 1
        where the model holds.
    log_density : float
        Natural logarithm of the predictive density, up to a constant of the data: Laplace's approximation about where
        the data take what that fit leaves uncertain.
    """

    error: float
    log_density: float


NOTHING_HELD_OUT = HeldOut(float("nan"), float("nan"))


def held_out(observations: Observations, fit: Fit) -> HeldOut:
    """Fit to all but one part, predict that part, in turn; scatters as they are in `fit`.

    No part may lie further out than parts scatter: otherwise a part moved far from its prior would stand in for the
    effect and predict just as well.
    """
    return held_out_of_each(observations, [fit])[0]


def held_out_of_each(
    observations: Observations, fits: Sequence[Fit], processes: int | None = 1
) -> list[HeldOut]:
    """The same of several fits; `processes` share the parts of all, None for one per processor."""
    folds = list(observations.folds())
    reach = [part_reach(observations, fit.posterior) for fit in fits]

    def told(item: tuple[int, int]) -> tuple[float, int, float]:
        fit, most = fits[item[0]], reach[item[0]]
        kept, out = folds[item[1]]
        problem, scatters = fit.model.problem(kept), fit.posterior.scatters
        start = transferred(fit.posterior, problem.unknowns, problem.start())
        return _predicted(out, fit, descend(Bounded(problem, most), scatters, start, steps=_STEPS))

    items = list(product(range(len(fits)), range(len(folds))))
    parts = list(spread(told, items, processes))
    return [_summed(parts[k * len(folds) : (k + 1) * len(folds)]) for k in range(len(fits))]


def _summed(parts: Sequence[tuple[float, int, float]]) -> HeldOut:
    squares, count, density = (sum(of) for of in zip(*parts, strict=True)) if parts else (0.0, 0, 0.0)
    return HeldOut(float(np.sqrt(squares / count)), density) if count else NOTHING_HELD_OUT


def _predicted(out: Observations, fit: Fit, trained: Posterior) -> tuple[float, int, float]:
    """Sum of squares, its number of terms, and log density of one part."""
    problem = fit.model.problem(out)
    x = transferred(trained, problem.unknowns)
    prior = problem.unknowns.prior_std(trained.scatters)
    covariance = np.diag(prior**2)
    known = [trained.unknowns.index.get(n, -1) for n in problem.unknowns.names]
    at = np.array([i for i, k in enumerate(known) if k >= 0], int)
    to = np.array([k for k in known if k >= 0], int)
    covariance[np.ix_(at, at)] = trained.covariance[np.ix_(to, to)]
    given = _Given(problem, x, covariance)
    as_fitted = given.residuals(np.zeros(len(x)), trained.scatters)
    if not np.all(np.isfinite(as_fitted.values)):
        return 0.0, 0, -np.inf
    count = max(as_fitted.count, 1)
    squares = _squares(as_fitted) + 2 * as_fitted.penalty
    told = descend(given, trained.scatters, np.zeros(len(x)), steps=_FOLLOWED)
    found = told.residuals
    to_first_order = replace(found, values=found.values - found.jacobian @ told.x)
    return squares, count, -_cost(to_first_order) - found.log_scale - found.penalty


class _Given:
    """A problem after a fit to other data: its unknowns are what that leaves uncertain, in standard deviations.

    Far from the prediction its first order does not hold: how two close modes turn into each other depends on the
    damping of each, and teeth may part in those hits only that are held out.

    Parameters
    ----------
    problem : Problem
    x : ndarray, (n,)
        As fitted.
    covariance : ndarray, (n, n)
    """

    def __init__(self, problem: Problem, x: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
        self._problem, self._x = problem, x
        size, directions = np.linalg.eigh(covariance)
        self._factor = directions * np.sqrt(np.maximum(size, 0.0))
        self.unknowns = Unknowns.plain([f"direction {k}" for k in range(len(x))], 1.0)

    def residuals(
        self,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        """See `Problem`."""
        at = self._problem.unknowns.clipped(self._x + self._factor @ x)
        found = self._problem.residuals(at, scatters, heat=heat, matching=matching, derivatives=derivatives)
        return replace(found, jacobian=found.jacobian @ self._factor)


def _squares(found: Residuals) -> float:
    """Sum of squares in which errors count, what is uncertain allowed for."""
    if found.block is None and found.relative is not None:
        return _marginal(found.stated, found.jacobian * found.relative[:, None])[0]
    return _marginal(found.values, found.jacobian)[0] if found.block is None else _whitened(found)[0].squares


def _cost(found: Residuals) -> float:
    """-log density but for what wider scatters and modes without a partner cost."""
    if found.block is None:
        squares, half_log_det = _marginal(found.values, found.jacobian)
        return 0.5 * squares + half_log_det
    whitened, half_log_det = _whitened(found)
    return whitened.cost + half_log_det


def _whitened(found: Residuals) -> tuple[Residuals, float]:
    """Each value predicted from those before it, and half the log determinant of their covariance."""
    factor = lower_factor(np.eye(len(found.values)) + found.jacobian @ found.jacobian.T)
    values = solve_lower(factor, found.values)
    whitened = Residuals(values, found.jacobian[:0], block=found.block, beside=found.beside)
    return whitened, float(np.sum(np.log(np.diag(factor))))


def _marginal(values: NDArray[np.float64], jacobian: NDArray[np.float64]) -> tuple[float, float]:
    """vᵀ(I + J Jᵀ)⁻¹v and half the log determinant, by the smaller matrix of as many rows as unknowns."""
    factor = lower_factor(np.eye(jacobian.shape[1]) + jacobian.T @ jacobian)
    taken = solve_lower(factor, jacobian.T @ values)
    return float(values @ values - taken @ taken), float(np.sum(np.log(np.diag(factor))))
