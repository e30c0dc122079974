"""The verdict: one word, read from the selection."""

from __future__ import annotations

import numpy as np
import scipy.special

from ema_pipeline.diagnose.claims import Judged
from ema_pipeline.diagnose.selection import Selection
from ema_pipeline.diagnose.settings import MOST_UNEXPLAINED, DiagnoseSettings
from ema_pipeline.diagnose.types import OutlyingDamping, OutlyingPart, VerdictWord
from ema_pipeline.inference import beyond
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, at_scatters, part_reach, within_scatter
from ema_pipeline.observations.mode_rows import FREQUENCY, FREQUENCY_NOISE, SHAPE
from ema_pipeline.observations.parts import DAMPING_SCATTER, FREE_STD

_OF_TESTS = (FREQUENCY, FREQUENCY_NOISE, SHAPE)
"""Scatters of what tests and models have wrong, and no parts. In 118 simulated tests of rigs without fault none was
more than a fifteenth above its default, which is what is usual; what was not in the library and was missed had brought
them to twice their defaults. Those of parts differ from rig to rig: masses of a right model scattered by 4 %."""
_USUAL_DAMPING_SCATTER = 0.5
"""1 σ of ln ζ from mode to mode in normal laboratories, where nothing but joints, cables and the suspension damps."""
_BY_CHANCE = 0.005
"""Probability by which damping ratios may scatter as they do and no damper be missing."""
_OF_SCATTER = 0.5
"""Share of its variance from which a damping ratio tells of their scatter, and not of the test."""


def explains(observations: Observations, fit: Fit, settings: DiagnoseSettings) -> bool:
    """True where the model explains the data, all measured modes but one, no part further out than parts scatter."""
    found = within_scatter(observations, at_usual_scatters(observations, fit)).posterior
    return (
        not found.fails(settings.error_limit)
        and found.residuals.unexplained <= MOST_UNEXPLAINED
        and not stands_still(observations, fit)
        and outlying_damping(observations, fit) is None
    )


def at_usual_scatters(observations: Observations, fit: Fit) -> Fit:
    """The fit with frequencies and shapes no further from the model's than usual; the same where they are not.

    Scatters that are learned take up what a model lacks.
    """
    usual = {n: observations.scatters[n].default for n in _OF_TESTS if n in observations.scatters}
    learned = fit.posterior.scatters
    capped = {n: min(value, usual.get(n, value)) for n, value in learned.items()}
    return fit if capped == learned else at_scatters(observations, fit, capped)


def stands_still(observations: Observations, fit: Fit) -> bool:
    """True where modes are seen to move with the force, and nothing in the model moves them.

    Few modes that move weigh little in the error of all.
    """
    return observations.level_dependent and all(e.effect.linear for e in fit.model.effects)


def outlying_damping(observations: Observations, fit: Fit) -> OutlyingDamping | None:
    """Damping ratios that scatter about the model's more than those of structures that lack no damper.

    Damping follows no law, so its scatter is learned. That alone would hide a damper which the library lacks: of seven
    such dampers in simulated tests, six were taken for scatter.
    """
    p = fit.posterior
    share = p.residuals.share.get(DAMPING_SCATTER)
    if share is None or DAMPING_SCATTER not in observations.scatters:
        return None
    on = share > _OF_SCATTER
    count = int(np.sum(on))
    if not count:  # a scatter that is stated to be none has no share
        return None
    usual = max(_USUAL_DAMPING_SCATTER, observations.scatters[DAMPING_SCATTER].default)
    variance = 1 - share[on] + share[on] * (usual / p.scatters[DAMPING_SCATTER]) ** 2
    squares = float(np.sum(p.residuals.values[on] ** 2 / variance))
    if scipy.special.chdtrc(count, squares) > _BY_CHANCE:
        return None
    return OutlyingDamping(usual * float(np.sqrt(squares / count)), usual)


def outlying_parts(observations: Observations, fit: Fit) -> tuple[OutlyingPart, ...]:
    """Every part that lies further out than parts scatter, furthest first."""
    p = fit.posterior
    one_sigma = part_reach(observations, p, furthest=1.0)
    names = [p.unknowns.names[i] for i in np.flatnonzero(beyond(p, part_reach(observations, p)))]
    found = [OutlyingPart(n, float(np.expm1(p.value(n))), one_sigma[n]) for n in names]
    return tuple(sorted(found, key=lambda part: -abs(part.deviation) / part.others))


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

    Where one of the rig's own effects is among them, it is named, and generic ones stand beside it as equivalents; not
    so where it is but a part out of tolerance.
    """
    for k in reversed(range(len(found.claimed))):
        near = found.rounds[k].alike(settings)
        own = tuple(j for j in near if not j.hypothesis.generic)
        contenders = own if any(j.specific for j in own) else near
        if len(contenders) > 1:
            return contenders
    return ()
