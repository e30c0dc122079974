"""Log evidence that an effect is expected to gain, given how far it moves what is predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.score import Marginal
from ema_pipeline.inference import CostOverScatters, Posterior, Scatter


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
        self._cost = CostOverScatters(fit, scatters, marginal.kept)

    def change(self, residuals: NDArray[np.float64]) -> Change:
        """Of a change of the residuals, (m,)."""
        return self.of_moved(*self.marginal.left(residuals))

    def of_moved(self, left: NDArray[np.float64], moved: NDArray[np.float64]) -> Change:
        """Of weighted residuals, (m,), and of unknowns that have moved by so many prior σ, (n,)."""
        square = moved**2
        unknowns = np.array([np.sum(square[at]) for at in self._cost.governed])
        return Change(left**2, unknowns, max(float(np.sum(square) - np.sum(unknowns)), 0.0))

    def of(self, change: Change, factor: float = 1.0) -> float:
        """Expected gain where the squared distance is `factor` times as large."""
        return 0.5 * factor * change.rest + self._cost.more(
            factor * change.residuals, factor * change.unknowns
        )
