"""The final model once more, with what was known to first order only calculated in full.

What is claimed was found by equivalent linearisation, in seconds for a hundred hypotheses. Where that finds sizes that
are far too small, it is not what they are stated by.
"""

from __future__ import annotations

from dataclasses import replace

from ema_pipeline.diagnose.selection import Selection
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, refined


def in_full(found: Selection) -> Selection:
    """The selection with the sizes that a calculation in full gives, where it explains the data better."""
    observations, final = fit_in_full(found.observations, found.final)
    return found if final is found.final else replace(found, final=final, observations=observations)


def fit_in_full(observations: Observations, fit: Fit) -> tuple[Observations, Fit]:
    """The data, and the fit to them, calculated in full; both as they are where that explains the data no better."""
    model, posterior = fit.model, fit.posterior
    full = observations.in_full(model.effects, posterior)
    if full is observations:
        return observations, fit
    starts = model.problem(full).sized_anew(posterior.x)
    tried = [refined(full, model, x, posterior.scatters) for x in starts]
    final = max(tried, key=lambda one: one.log_evidence)
    return (full, final) if final.log_evidence > fit.log_evidence else (observations, fit)
