"""Cost of squares that are larger than they were: the scatters rise together until they explain them best."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import tails
from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import in_blocks
from ema_pipeline.inference.scatter import Scatter, determined

_STEPS, _CONVERGED = 12, 1e-2
"""Most steps, and the fall of the cost in the last one."""
_LONGEST = 0.8
"""Longest step, as a share of what one over a variance is."""


class CostOverScatters:
    """Least cost of squares over all values of the scatters.

    Parameters
    ----------
    fit : Posterior
        With learned scatters.
    scatters : dict of str to Scatter
    kept : ndarray of bool, (n,)
        Unknowns that count.

    Attributes
    ----------
    governed : list of ndarray of bool, (n_kept,)
        By scatter that is learned: mask of the kept unknowns whose prior it governs.
    """

    def __init__(self, fit: Posterior, scatters: Mapping[str, Scatter], kept: NDArray[np.bool_]) -> None:
        learned = [s for n, s in scatters.items() if s.spread and n in fit.scatters]
        self.governed = [fit.unknowns.governed(s.name)[kept] for s in learned]
        self._square, self._block = fit.expected_squares(), fit.residuals.block
        self._shares = np.zeros((len(self._square), len(learned)))
        for k, s in enumerate(learned):
            self._shares[:, k] = fit.residuals.share.get(s.name, 0.0)
        self._fixed = 1 - np.sum(self._shares, axis=1)
        self._unweighted = fit.residuals.weight**-2.0
        of_residuals = np.sum(self._shares, axis=0)
        self._values = np.array([determined(fit, s.name) for s in learned]) - of_residuals
        now = np.array([np.log(fit.scatters[s.name]) for s in learned])
        self._above = np.where(of_residuals > 0, now - np.log([s.default for s in learned]), 0.0)
        self._weight = np.array([s.spread**-2.0 for s in learned])
        self._widest = np.maximum(2 * (np.log([s.most * s.default for s in learned]) - now), 0.0)
        least = np.array([s.least * s.default for s in learned])
        self._narrowest = np.minimum(2 * (np.log(np.maximum(least, 1e-300)) - now), 0.0)
        self._as_fitted = self._least(np.zeros(len(self._square)), np.zeros(len(learned)))

    def more(self, residuals: NDArray[np.float64], unknowns: NDArray[np.float64]) -> float:
        """By how much the cost is higher, in units of log evidence.

        Parameters
        ----------
        residuals : ndarray, (m,)
            By how much the square of every residual is larger.
        unknowns : ndarray, (k,)
            By how much those of the unknowns are, summed over the ones that each scatter governs.
        """
        return max(self._least(residuals, unknowns) - self._as_fitted, 0.0)

    def _least(self, residuals: NDArray[np.float64], unknowns: NDArray[np.float64]) -> float:
        """By Newton's method within the range of every scatter.

        With t = (scatter/now)², a residual's variance is 1 - share + share·t times what it is now, summed over the
        scatters; that of unknowns is t.
        """
        square, count, of_unknowns = self._square + residuals, self._values, self._values + unknowns
        log, diagonal = np.zeros(len(self._weight)), np.arange(len(self._weight))
        least, best, step = np.inf, log, log
        for _ in range(_STEPS):
            added = self._shares * np.exp(log)
            variance = self._fixed + np.sum(added, axis=1)
            above, inverse = self._above + 0.5 * log, np.exp(-log)
            own = square / variance
            of_residuals, factor = self._density(own)
            cost = of_residuals + 0.5 * float(
                np.sum(np.log(variance))
                + np.sum(count * log + of_unknowns * inverse + self._weight * above**2)
            )
            if not cost < least:
                step = 0.5 * step
                log = best + step
                continue
            least, best = cost, log
            part, excess = added / variance[:, None], own * factor
            slope = 0.5 * (part.T @ (1 - excess) + count - of_unknowns * inverse + self._weight * above)
            # no less than the true one: negative parts are left out
            of_two = np.where(excess > 1, excess, 2 * excess - 1)
            curvature = 0.5 * (part.T @ (of_two[:, None] * part))
            curvature[diagonal, diagonal] += (
                0.5 * (part.T @ np.maximum(1 - excess, 0.0) + of_unknowns * inverse) + 0.25 * self._weight
            )
            held = ((log >= self._widest) & (slope < 0)) | ((log <= self._narrowest) & (slope > 0))
            slope[held], curvature[held], curvature[:, held] = 0.0, 0.0, 0.0
            curvature[held, held] = 1.0
            newton = -np.linalg.solve(curvature, slope)
            if -0.5 * float(slope @ newton) < _CONVERGED:
                break
            # in one over the variance, in which the cost of unknowns is linear but for a logarithm
            step = -np.log1p(-np.minimum(newton, _LONGEST))
            log = np.clip(best + step, self._narrowest, self._widest)
            step = log - best
        return least

    def _density(self, square: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """-log density of residuals by weighted squares, up to a constant, and its slope over a Gaussian's, (m,)."""
        factor = np.ones(len(square))
        if self._block is None:
            return 0.5 * float(np.sum(square)), factor
        inside, blocks = self._block >= 0, in_blocks(square * self._unweighted, self._block)
        factor[inside] = self._unweighted[inside] * tails.weight(*blocks)[self._block[inside]]
        return 0.5 * float(np.sum(square[~inside])) + float(np.sum(tails.cost(*blocks))), factor
