"""How probable every hypothesis is, and how much evidence one of them needs among so many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import expit

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.naming import named
from ema_pipeline.diagnose.ranked import Ranking
from ema_pipeline.diagnose.settings import DiagnoseSettings

NOTHING = "nothing"
UNKNOWN = "an effect that is not in the library"
CLOSEST = 0.5
"""Probability that what is claimed is right where the model does not explain the data with it either, over what it
would be if it did: of eight such claims in simulated tests whose effects are in the library five were right, of twelve
where they are not none."""


def weight(hypothesis: Hypothesis, settings: DiagnoseSettings) -> float:
    """Prior weight of a hypothesis among the others."""
    return settings.generic_prior if hypothesis.generic else 1.0


def null_prior(settings: DiagnoseSettings, found: int) -> float:
    """Prior probability that nothing is missing beside `found` effects."""
    return settings.further_null_prior if found else settings.null_prior


def prior(
    hypothesis: Hypothesis, hypotheses: Sequence[Hypothesis], settings: DiagnoseSettings, found: int
) -> float:
    """Prior probability of one among all hypotheses, beside `found` effects."""
    total = sum(weight(h, settings) for h in hypotheses)
    return (1 - null_prior(settings, found)) * weight(hypothesis, settings) / total


def probabilities(
    ranking: Ranking,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
    believed: Mapping[str, float] | None = None,
    least: float = -np.inf,
) -> dict[str, float]:
    """Probability of every ranked hypothesis by the name that is said, and of `NOTHING`; adds up to 1.

    Parameters
    ----------
    ranking : Ranking
    hypotheses : sequence of Hypothesis
        All that were asked about, among which those that were not ranked have their share of the prior.
    settings : DiagnoseSettings
    found : int
        Effects that were found before.
    believed : dict of str to float, optional
        What counts of the gain of some, by their names.
    least : float, optional
        Gain below which nothing of it counts.
    """
    names = [named(r.hypothesis, r.fit) for r in ranking.ranked]

    def counted(gain: float, label: str) -> float:
        value = (believed or {}).get(label, gain)
        return min(value, 0.0) if gain < least else value

    logs = [
        counted(r.gain + n.advantage, n.label) + np.log(prior(r.hypothesis, hypotheses, settings, found))
        for r, n in zip(ranking.ranked, names, strict=True)
    ]
    everything = np.array([*logs, np.log(null_prior(settings, found))])
    shares = np.exp(everything - np.max(everything))
    shares /= np.sum(shares)
    told = {n.label: float(p) for n, p in zip(names, shares, strict=False)}
    return told | {NOTHING: float(shares[-1])}


def of_failing_model(told: Mapping[str, float], named: float = 1.0) -> dict[str, float]:
    """The same where the model does not explain the data: what nothing missing had goes to `UNKNOWN`.

    So does what effects that are named do not keep, a share `named`: `CLOSEST` where the model fails with them, too.
    """
    kept = {name: 0.0 if name == NOTHING else named * p for name, p in told.items()}
    return kept | {UNKNOWN: max(1.0 - sum(kept.values()), 0.0)}


def against_nothing(
    hypothesis: Hypothesis,
    gain: float,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    found: int,
) -> float:
    """Probability of one hypothesis against nothing alone, where no others were weighed beside it."""
    odds = prior(hypothesis, hypotheses, settings, found) / null_prior(settings, found)
    return float(expit(gain + np.log(odds)))


def needed(
    hypothesis: Hypothesis, hypotheses: Sequence[Hypothesis], settings: DiagnoseSettings, found: int
) -> float:
    """Log evidence that one hypothesis has to gain to be claimed where all others gain nothing."""
    odds = null_prior(settings, found) / prior(hypothesis, hypotheses, settings, found)
    return max(settings.claim, float(np.log((1 - settings.doubt) / settings.doubt * odds)))
