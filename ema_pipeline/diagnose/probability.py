"""How probable every hypothesis is, and how much evidence one of them needs among so many."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import expit
from scipy.stats import norm

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.naming import named
from ema_pipeline.diagnose.ranked import Ranking
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, UNKNOWN

CLOSEST = 0.5
"""Probability that what is claimed is right where the model does not explain the data with it either, over what it
would be if it did: of eight such claims in simulated tests whose effects are in the library five were right, of twelve
where they are not none."""

_OUTSIDE = 0.02
"""Prior probability that something is missing that is not in the library, and yet the model is near the data."""
_USUAL_ERROR, _USUAL_SPREAD = 0.93, 0.11
"""Mean error, and its 1 σ for many data, of 400 models of simulated rigs that lacked nothing."""


def weight(hypothesis: Hypothesis, settings: DiagnoseSettings) -> float:
    """Prior weight of a hypothesis among the others."""
    return settings.generic_prior if hypothesis.generic else 1.0


def null_prior(settings: DiagnoseSettings, found: int) -> float:
    """Prior probability that nothing is missing beside `found` effects."""
    return 1 - (1 - settings.further_null_prior) ** found if found else settings.null_prior


def most_doubt(settings: DiagnoseSettings, found: int) -> float:
    """Largest probability that nothing is missing beside `found` effects at which another one is claimed."""
    return min(settings.doubt, settings.further_doubt) if found else settings.doubt


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


def divided_as(rivals: Mapping[str, float], told: Mapping[str, float]) -> dict[str, float]:
    """Probabilities in which `NOTHING` has that of `told`, and effects share the rest as they do in `rivals`."""
    shares, rest = (math.fsum(p for name, p in of.items() if name != NOTHING) for of in (rivals, told))
    if not shares:
        return dict(told)
    return {name: p * rest / shares for name, p in rivals.items()} | {NOTHING: told[NOTHING]}


def complete(error: float, count: int) -> float:
    """Probability that a model which explains the data lacks nothing that the library lacks, by its error.

    Effects that are not in the library may be followed by others that are, and by scatter: of 13 such claims in
    simulated tests eight had errors of 1.2 to 1.5, of 290 right ones five. Below 1 an error tells nothing of them.

    Parameters
    ----------
    error : float
    count : int
        Number of data.
    """
    spread = math.hypot(_USUAL_SPREAD, 1 / math.sqrt(2 * max(count, 1)))
    usual = (1 - _OUTSIDE) * float(norm.pdf(error, _USUAL_ERROR, spread))
    outside = _OUTSIDE * 8 * max(error - 1, 0.0)  # up from 1 to the limit of few data, 1.5
    return usual / (usual + outside)


def shared(told: Mapping[str, float], named: float, nothing: float) -> dict[str, float]:
    """Probabilities of which the effects that are named, and `NOTHING`, keep a share: the rest is that of `UNKNOWN`."""
    shares = {name: nothing if name == NOTHING else named for name in told}
    rest = math.fsum(p * (1 - shares[name]) for name, p in told.items())
    return {name: p * shares[name] for name, p in told.items()} | ({UNKNOWN: rest} if rest else {})


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
    doubt = most_doubt(settings, found)
    return max(settings.claim, float(np.log((1 - doubt) / doubt * odds)))
