"""Hypotheses in the order of the evidence that they gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.observations.fitting import Fit

T = TypeVar("T")

BEATEN = 200.0
"""Log evidence behind the best hypothesis from which another one cannot catch up: it is not begun again."""


@dataclass(frozen=True)
class Ranked:
    """One hypothesis on top of the model.

    Attributes
    ----------
    hypothesis : Hypothesis
    fit : Fit
    gain : float
        Log evidence against the model without it, both with learned scatters where it is a finalist.
    final : bool
        True where its scatters were learned.
    """

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    final: bool


@dataclass(frozen=True)
class Ranking:
    """The current model, and all hypotheses by evidence.

    Attributes
    ----------
    base : Fit
        With learned scatters.
    ranked : tuple of Ranked
        Best first.
    linearised : bool
        True where equivalent linearisation alone tells what effects do that depend on the amplitude.
    """

    base: Fit
    ranked: tuple[Ranked, ...]
    linearised: bool = False

    @property
    def unpaired(self) -> float:
        """Least that modes without a partner cost, over all hypotheses."""
        return min((r.fit.posterior.residuals.penalty for r in self.ranked), default=0.0)


def unbeaten(best_first: Sequence[T], evidence: Callable[[T], float]) -> list[T]:
    """Those that can catch up with the first one."""
    return [one for one in best_first if evidence(one) >= evidence(best_first[0]) - BEATEN]
