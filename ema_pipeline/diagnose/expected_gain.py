"""Log evidence that an effect is expected to gain, given how far it moves what is predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.score import Marginal
from ema_pipeline.inference import Posterior, Scatter, tails
from ema_pipeline.inference.problem import in_blocks
from ema_pipeline.inference.scatter import determined

_STEPS = 12
_LONGEST = 1.5
"""Steps, and longest step in the logarithm of a variance, of the search for the scatters that take a change up."""


@dataclass(frozen=True)
class Change:
    """How far an effect moves the predictions and, everything uncertain having followed, the unknowns.

    Attributes
    ----------
    residuals : ndarray, (m,)
        Squared, in squared standard deviations, of every residual.
    unknowns : ndarray, (k,)
        Squared, summed over the unknowns that each of k scatters governs.
    rest : float
        Squared, of unknowns whose prior is not learned.
    """

    residuals: NDArray[np.float64]
    unknowns: NDArray[np.float64]
    rest: float

    @property
    def total(self) -> float:
        """Squared distance in standard deviations."""
        return self.rest + float(np.sum(self.residuals) + np.sum(self.unknowns))


class ExpectedGain:
    """Gains on top of one fitted model.

    A model without the effect can take it for scatter: its scatters rise together until they explain it best. One that
    n values determine makes a squared distance z² gain n/2·ln(1 + z²/n), as in Student's test, and not z²/2. Shapes of
    a few modes that are far off gain less still: their density has tails (`inference.tails`).

    Parameters
    ----------
    fit : Posterior
    scatters : dict of str to Scatter
    marginal : Marginal
        Of the same fit.
    """

    def __init__(self, fit: Posterior, scatters: Mapping[str, Scatter], marginal: Marginal) -> None:
        self.marginal = marginal
        learned = [s for n, s in scatters.items() if s.spread and n in fit.scatters]
        self._governed = [fit.unknowns.governed(s.name)[marginal.kept] for s in learned]
        self._shares = np.zeros((marginal.count, len(learned)))
        for k, s in enumerate(learned):
            self._shares[:, k] = fit.residuals.share.get(s.name, 0.0)
        self._fixed = 1 - np.sum(self._shares, axis=1)
        self._square, self._block = fit.expected_squares(), fit.residuals.block
        self._unweighted = fit.residuals.weight**-2.0
        of_residuals = np.sum(self._shares, axis=0)
        self._values = np.array([determined(fit, s.name) for s in learned]) - of_residuals
        now = np.array([np.log(fit.scatters[s.name]) for s in learned])
        self._above = np.where(of_residuals > 0, now - np.log([s.default for s in learned]), 0.0)
        self._weight = np.array([s.spread**-2.0 for s in learned])
        self._widest = np.maximum(2 * (np.log([s.most * s.default for s in learned]) - now), 0.0)
        self._least = self._cost(np.zeros(marginal.count), np.zeros(len(learned)))

    def change(self, residuals: NDArray[np.float64]) -> Change:
        """Of a change of the residuals, (m,)."""
        return self.of_moved(*self.marginal.left(residuals))

    def of_moved(self, left: NDArray[np.float64], moved: NDArray[np.float64]) -> Change:
        """Of weighted residuals, (m,), and of unknowns that have moved by so many prior σ, (n,)."""
        square = moved**2
        unknowns = np.array([np.sum(square[at]) for at in self._governed])
        return Change(left**2, unknowns, max(float(np.sum(square) - np.sum(unknowns)), 0.0))

    def of(self, change: Change, factor: float = 1.0) -> float:
        """Expected gain where the squared distance is `factor` times as large."""
        cost = self._cost(factor * change.residuals, factor * change.unknowns) - self._least
        return 0.5 * factor * change.rest + max(cost, 0.0)

    def _cost(self, residuals: NDArray[np.float64], unknowns: NDArray[np.float64]) -> float:
        """Least cost of squared distances over all values of the scatters, in units of log evidence.

        With t = (scatter/now)², a residual's variance is 1 - share + share·t times what it is now, summed over the
        scatters; that of unknowns is t.
        """
        square, count, of_unknowns = self._square + residuals, self._values, self._values + unknowns
        log, diagonal = np.zeros(len(self._weight)), np.arange(len(self._weight))
        best = np.inf
        for _ in range(_STEPS):
            added = self._shares * np.exp(log)
            variance = self._fixed + np.sum(added, axis=1)
            above = self._above + 0.5 * log
            inverse = np.exp(-log)
            own = square / variance
            of_residuals, factor = self._density(own)
            cost = of_residuals + 0.5 * float(
                np.sum(np.log(variance))
                + np.sum(count * log + of_unknowns * inverse + self._weight * above**2)
            )
            best = min(best, cost)
            part, excess = added / variance[:, None], own * factor
            slope = 0.5 * (part.T @ (1 - excess) + count - of_unknowns * inverse + self._weight * above)
            curvature = 0.5 * (part.T @ (np.maximum(excess, 1.0)[:, None] * part))
            curvature[diagonal, diagonal] += 0.5 * of_unknowns * inverse + 0.25 * self._weight
            step = np.clip(-np.linalg.solve(curvature, slope), -_LONGEST, _LONGEST)
            log = np.minimum(log + step, self._widest)
        return best

    def _density(self, square: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """-log density of residuals by weighted squares, up to a constant, and its slope over a Gaussian's, (m,)."""
        factor = np.ones(len(square))
        if self._block is None:
            return 0.5 * float(np.sum(square)), factor
        inside, blocks = self._block >= 0, in_blocks(square * self._unweighted, self._block)
        factor[inside] = self._unweighted[inside] * tails.weight(*blocks)[self._block[inside]]
        return 0.5 * float(np.sum(square[~inside])) + float(np.sum(tails.cost(*blocks))), factor
