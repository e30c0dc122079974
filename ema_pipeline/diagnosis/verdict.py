"""The verdict: one word, read from the selection."""

from __future__ import annotations

from ema_pipeline.diagnose.types import VerdictWord
from ema_pipeline.diagnosis.claims import Judged
from ema_pipeline.diagnosis.selection import Selection
from ema_pipeline.diagnosis.settings import DiagnoseSettings
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit
from ema_pipeline.observations.parts import PART_SCATTER

_UNEXPLAINED_SHARE = 0.15
"""Share of the measured modes that may stay without a partner in a model that explains the data."""


def explains(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> bool:
    """True where the model explains the data with parts that scatter no more than such parts do."""
    return fit.posterior.error <= settings.error_limit and not scattered(observations, fit, settings)


def scattered(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> bool:
    """True where the parts would have to scatter far more than was stated."""
    stated = observations.scatters.get(PART_SCATTER)
    if stated is None or not stated.spread:
        return False
    return fit.posterior.scatters[PART_SCATTER] > settings.scatter_limit * stated.default


def verdict_of(observations: Observations, found: Selection, settings: DiagnoseSettings) -> VerdictWord:
    """What the data support."""
    if not explains(observations, found.final, settings):
        return "unknown_effect"
    if not found.claimed:
        return "adequate"
    return "ambiguous" if len(alike(found, settings)) > 1 else "effect"


def alike(found: Selection, settings: DiagnoseSettings) -> tuple[Judged, ...]:
    """Hypotheses of the round that claimed the last effect which explain the data as well.

    Where one of the rig's own effects is among them, it is named, and generic ones stand beside it as equivalents.
    """
    for k in reversed(range(len(found.claimed))):
        near = found.rounds[k].alike(settings)
        own = tuple(j for j in near if not j.hypothesis.generic)
        contenders = own or near
        if len(contenders) > 1:
            return contenders
    return ()
