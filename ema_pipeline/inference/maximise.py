"""Maximum a posteriori: Levenberg-Marquardt within bounds, annealed from wide uncertainties to true ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import Problem, Residuals, same_matching
from ema_pipeline.inference.unknowns import LARGEST_STEP, Unknowns

ANNEALING = ((30.0, 6), (5.0, 6), (1.0, 14))
"""Factors on the uncertainties and steps at each. Without them a fit begun far off ends in a local optimum."""

_CONVERGED = 1e-3
"""Fall of the log posterior in one step below which nothing changes that a decision would see."""
_MOST_TRIALS = 6
_AS_PROMISED = 0.2
"""Relative difference between the fall of the log posterior and that to second order, up to which the derivatives are
carried on from one point to the next by a secant."""
_MOST_SECANTS = 3
"""Such steps one after the other."""


def anneal(
    problem: Problem,
    scatters: Mapping[str, float],
    start: NDArray[np.float64],
    schedule: Sequence[tuple[float, int]] = ANNEALING,
) -> Posterior:
    """Descend with uncertainties that shrink from wide to true ones; the posterior at the end."""
    found = None
    for heat, steps in schedule:
        found = descend(problem, scatters, start if found is None else found.x, steps=steps, heat=heat)
    assert found is not None
    return found


def descend(
    problem: Problem,
    scatters: Mapping[str, float],
    start: NDArray[np.float64],
    *,
    steps: int = 14,
    heat: float = 1.0,
) -> Posterior:
    """Levenberg-Marquardt from `start`; never worse than it.

    Parameters
    ----------
    problem : Problem
    scatters : dict of str to float
    start : ndarray, (n,)
    steps : int
        Most steps.
    heat : float
        Factor on the uncertainties.

    Returns
    -------
    Posterior
        At the best point found.
    """
    unknowns = problem.unknowns
    std = unknowns.prior_std(scatters)
    x = unknowns.clipped(np.asarray(start, float))
    here = problem.residuals(x, scatters, heat=heat)
    cost = here.cost + _prior_cost(x, std)
    damping, secants, settled = 1e-2, 0, False
    for _ in range(steps if np.isfinite(cost) else 0):
        step_from = _Step(unknowns, x, std, *here.weighted)
        if settled and step_from.promised(step_from.to(damping)) < _CONVERGED:
            break
        for _ in range(1 if secants else _MOST_TRIALS):
            trial = step_from.to(damping)
            there = problem.residuals(trial, scatters, heat=heat, derivatives=False)
            trial_cost = there.cost + _prior_cost(trial, std)
            if trial_cost < cost:
                break
            damping *= 5.0
        else:
            if not secants:
                break
            # no way down with derivatives that were carried on: once more with exact ones
            here, secants = problem.residuals(x, scatters, heat=heat, matching=here.matching), 0
            continue
        fall, promised = cost - trial_cost, step_from.promised(trial)
        x, cost, damping = trial, trial_cost, max(damping / 5.0, 1e-6)
        settled = fall < _CONVERGED
        carried = None
        if not settled and secants < _MOST_SECANTS and abs(fall - promised) < _AS_PROMISED * promised:
            carried = _carried_on(here, there, trial - step_from.x, std)
        if carried is None:
            here, secants = problem.residuals(x, scatters, heat=heat, matching=there.matching), 0
        else:
            here, secants = carried, secants + 1
    if secants:
        here = problem.residuals(x, scatters, heat=heat, matching=here.matching)
    return Posterior(unknowns, x, dict(scatters), here)


def _carried_on(
    here: Residuals, there: Residuals, moved: NDArray[np.float64], std: NDArray[np.float64]
) -> Residuals | None:
    """Residuals at the next point, their derivatives as little changed as leads there; None where pairs are others.

    References
    ----------
    C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965) 577-593.
    """
    if len(there.values) != len(here.values) or not same_matching(here.matching, there.matching):
        return None
    along = moved / std**2
    missed = there.values - here.values - here.jacobian @ moved
    return replace(there, jacobian=here.jacobian + missed[:, None] * (along / (along @ moved)))


def _prior_cost(x: NDArray[np.float64], std: NDArray[np.float64]) -> float:
    return 0.5 * float(np.sum((x / std) ** 2))


class _Step:
    """Steps from one point, at any damping."""

    def __init__(
        self,
        unknowns: Unknowns,
        x: NDArray[np.float64],
        std: NDArray[np.float64],
        residual: NDArray[np.float64],
        jacobian: NDArray[np.float64],
    ) -> None:
        self.unknowns, self.x = unknowns, x
        self.gradient = jacobian.T @ residual + x / std**2
        self.hessian = jacobian.T @ jacobian + np.diag(std**-2.0)
        held_low = (x <= unknowns.lower) & (self.gradient > 0)
        held_high = (x >= unknowns.upper) & (self.gradient < 0)
        self.free = np.flatnonzero(~(held_low | held_high))
        self._of_free = self.hessian[np.ix_(self.free, self.free)]

    def promised(self, to: NDArray[np.float64]) -> float:
        """By how much the log posterior falls on the way to a point, to second order."""
        step = to - self.x
        return -float(step @ (self.gradient + 0.5 * (self.hessian @ step)))

    def to(self, damping: float) -> NDArray[np.float64]:
        """The point that a step with this damping leads to."""
        if not self.free.size:  # every unknown is held at a bound
            return self.x
        h = self._of_free
        damped = h.copy()
        np.fill_diagonal(damped, (1 + damping) * np.diag(h))
        step = np.zeros_like(self.x)
        try:
            factor = scipy.linalg.cho_factor(damped, check_finite=False)
            step[self.free] = -scipy.linalg.cho_solve(factor, self.gradient[self.free], check_finite=False)
        except np.linalg.LinAlgError:  # derivatives beyond what can be factorised: the steepest way down
            step[self.free] = -self.gradient[self.free] / np.maximum(np.diag(h), 1e-300)
        return self.unknowns.clipped(self.x + np.clip(step, -LARGEST_STEP, LARGEST_STEP))
