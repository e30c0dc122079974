"""Log evidence that an effect is expected to gain, given how far it moves what is predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.score import Marginal
from ema_pipeline.inference import Posterior, Scatter
from ema_pipeline.inference.scatter import determined

_LOGS = np.linspace(0.0, 1.0, 33)


@dataclass(frozen=True)
class Change:
    """Squared distance by which an effect moves the predictions, everything uncertain having followed.

    Attributes
    ----------
    of_scatter : dict of str to float
        Parts that a learned scatter can take up, by its name.
    rest : float
        What none can.
    """

    of_scatter: Mapping[str, float]
    rest: float

    @property
    def total(self) -> float:
        """Squared distance in standard deviations."""
        return self.rest + sum(self.of_scatter.values())


class ExpectedGain:
    """Gains on top of one fitted model.

    A model without the effect can take it for scatter. A scatter that n values determine rises until it explains
    them, so that a distance z gains n/2·ln(1 + z²/n), as in Student's test, and not z²/2.

    Parameters
    ----------
    fit : Posterior
    scatters : dict of str to Scatter
    marginal : Marginal
        Of the same fit.
    """

    def __init__(self, fit: Posterior, scatters: Mapping[str, Scatter], marginal: Marginal) -> None:
        self.marginal = marginal
        learned = {n: s for n, s in scatters.items() if s.spread and n in fit.scatters}
        self.unknowns = {n: fit.unknowns.governed(n)[marginal.kept] for n in learned}
        self.shares = {n: fit.residuals.share[n] for n in learned if n in fit.residuals.share}
        self.values = {n: determined(fit, n) for n in learned}
        self.spread = {n: s.spread for n, s in learned.items()}
        self.widest = {
            n: max(2 * float(np.log(s.most * s.default / fit.scatters[n])), 0.0) for n, s in learned.items()
        }

    def change(self, residuals: NDArray[np.float64]) -> Change:
        """Of a change of the residuals, (m,)."""
        left, moved = self.marginal.left(residuals)
        parts = {
            n: float(np.sum(moved[at] ** 2)) + float(np.sum(self.shares.get(n, np.zeros(1)) * left**2))
            for n, at in self.unknowns.items()
        }
        return Change(parts, max(float(left @ left + moved @ moved) - sum(parts.values()), 0.0))

    def of(self, change: Change, factor: float = 1.0) -> float:
        """Expected gain where the squared distance is `factor` times as large."""
        gain = 0.5 * factor * change.rest
        for name, square in change.of_scatter.items():
            gain += self._beside_scatter(name, factor * square)
        return gain

    def _beside_scatter(self, name: str, square: float) -> float:
        """Least cost of a squared distance over all values of the scatter that may take it up."""
        n, logs = self.values[name], _LOGS * self.widest[name]
        prior = 0.5 * (0.5 * logs / self.spread[name]) ** 2
        return float(np.min(0.5 * (n * logs + (n + square) * np.exp(-logs) - n) + prior))
