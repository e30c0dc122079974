"""What these data would show: the least size of every effect that would be claimed nine times in ten.

A size s that is known to ±σ raises -2 log posterior by (s/σ)². A claim needs as much as the threshold of its
family asks for, and as much as its prior odds and Occam's factor ask for until it is probable enough; 1.28 σ
on top make it nine cases in ten.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, extras, prior_probabilities
from ema_pipeline.diagnose.ranking import Ranking
from ema_pipeline.diagnose.thresholds import threshold
from ema_pipeline.diagnose.types import OUT_OF_TOLERANCE, DetectionLimit

_NINE_IN_TEN = 1.2816
"""Ninety per cent of a normal distribution lie above its mean less this many standard deviations."""


def detection_limits(
    case: Case, ranking: Ranking, thresholds: Mapping[str, float] | None = None
) -> tuple[DetectionLimit, ...]:
    """The detection limit of every hypothesis that has a size with a null.

    Parameters
    ----------
    case : Case
    ranking : Ranking
        On top of a model that holds.
    thresholds : mapping of family to gain, optional

    Returns
    -------
    tuple of DetectionLimit
        In the order of the hypotheses; `size` is infinite where no allowed size would be seen. For a parameter
        out of tolerance it is the relative deviation from the nominal value.
    """
    settings = case.settings
    prior = prior_probabilities(
        [f.hypothesis for f in ranking.fitted], settings.null_prior, settings.parameter_prior
    )
    odds = settings.probability_least / (1 - settings.probability_least)
    found = []
    for f in ranking.fitted:
        label = f.hypothesis.label
        occam = 0.5 * ranking.gain(f) - ranking.log_evidence(f)
        believed = 2 * (np.log(odds * prior[NOTHING] / max(prior[label], 1e-300)) + occam)
        least = threshold(f.hypothesis.family, settings.gain_least, thresholds)
        steps = float(np.sqrt(max(least, believed))) + _NINE_IN_TEN
        found += _limits(case, f, steps)
    return tuple(found)


def _limits(case: Case, f: Fitted, steps: float) -> list[DetectionLimit]:
    last = f.hypothesis.labels[-1]
    family, _, place = last.partition("@")
    if family == OUT_OF_TOLERANCE:
        p = case.rig.parameters[place]
        sigma = float(np.hypot(f.std.get(place, np.inf) / abs(p.value), p.tolerance))
        return [DetectionLimit(last, place, steps * sigma, "1")]
    parameters = case.problem(f.hypothesis, case.settings.fit).rig.parameters
    found = []
    for e in extras(case.rig, Hypothesis((last,)), case.library):
        if e.scale == 0 or e.name not in f.std:
            continue
        p = parameters[e.name]
        size = max(steps * f.std[e.name], e.slight)
        room = max(p.maximum - e.null, e.null - p.minimum)
        found.append(
            DetectionLimit(
                last, e.name.removeprefix(f"{last}."), size if size <= room else float("inf"), p.unit
            )
        )
    return found
