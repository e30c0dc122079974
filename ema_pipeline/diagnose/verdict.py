"""The verdict: one word, read from the selection."""

from __future__ import annotations

from ema_pipeline.diagnose.claims import Judged
from ema_pipeline.diagnose.selection import Selection
from ema_pipeline.diagnose.settings import MOST_UNEXPLAINED, DiagnoseSettings
from ema_pipeline.diagnose.types import VerdictWord
from ema_pipeline.observations.fitting import Fit
from ema_pipeline.observations.parts import FREE_STD


def too_few(fit: Fit) -> bool:
    """True where there is no datum left for an effect once every free parameter has taken one."""
    unknowns, residuals = fit.posterior.unknowns, fit.posterior.residuals
    loose = [
        name
        for name, std, scatter in zip(unknowns.names, unknowns.std, unknowns.scatter, strict=True)
        if not scatter and "@" not in name and std >= FREE_STD[0]
    ]
    return residuals.count <= len(loose) + 1


def verdict_of(found: Selection, settings: DiagnoseSettings, explained: bool) -> VerdictWord:
    """What the data support; `explained` where the final model explains them, see `Explanation.explained`."""
    unpaired = found.final.posterior.residuals.unexplained > MOST_UNEXPLAINED
    if not found.claimed and too_few(found.final) and not unpaired:
        return "not_enough_data"
    if not explained:
        return "unknown_effect"
    if not found.claimed:
        return "adequate"
    return "ambiguous" if len(alike(found)) > 1 else "effect"


def alike(found: Selection) -> tuple[Judged, ...]:
    """The last claim in whose place others explain the data as well, and these.

    Where one of the rig's own effects is among them, it is named, and generic ones stand beside it as equivalents; not
    so where it is but a part out of tolerance.
    """
    for near in reversed(found.alike):
        own = tuple(j for j in near if not j.hypothesis.generic)
        contenders = own if any(j.specific for j in own) else near
        if len(contenders) > 1:
            return contenders
    return ()
