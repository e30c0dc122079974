"""The verdict: one word, read from the selection."""

from __future__ import annotations

import numpy as np

from ema_pipeline.diagnose.claims import Judged
from ema_pipeline.diagnose.selection import Selection
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import VerdictWord
from ema_pipeline.inference import beyond_scatter
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import PARTS, Fit, within_scatter
from ema_pipeline.observations.parts import FREE_STD

MOST_UNEXPLAINED = 1
"""Measured modes without a partner in a model that explains the data: one may be invented, or of the floor."""


def explains(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> bool:
    """True where the model explains the data, all measured modes but one, no part further out than parts scatter."""
    found = within_scatter(observations, fit).posterior
    return found.error <= settings.error_limit and found.residuals.unexplained <= MOST_UNEXPLAINED


def outlying_parts(fit: Fit) -> dict[str, float]:
    """Relative deviation of every part that lies further out than the scatter of parts reaches, furthest first."""
    names = fit.posterior.unknowns.names
    found = {
        names[i]: float(np.expm1(fit.posterior.x[i]))
        for i in np.flatnonzero(beyond_scatter(fit.posterior, PARTS))
    }
    return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))


def too_few(fit: Fit) -> bool:
    """True where there is no datum left for an effect once every free parameter has taken one."""
    unknowns, residuals = fit.posterior.unknowns, fit.posterior.residuals
    loose = [
        name
        for name, std, scatter in zip(unknowns.names, unknowns.std, unknowns.scatter, strict=True)
        if not scatter and "@" not in name and std >= FREE_STD[0]
    ]
    return len(residuals.values) - residuals.projected <= len(loose) + 1


def verdict_of(found: Selection, settings: DiagnoseSettings, explained: bool) -> VerdictWord:
    """What the data support; `explained` where the final model explains them, see `explains`."""
    if not found.claimed and too_few(found.final):
        return "not_enough_data"
    if not explained:
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
