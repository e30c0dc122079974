"""Noise level: how large is what even the best model leaves, in frequency, damping and shape?

The floors of `UncertaintySettings` say what a comparison with a model may leave at most in good work. A test on a
steady rig leaves less, and small effects are then visible that the floors would hide. So the level is taken from
what the best hypotheses leave, between `noise_least` times the floors and the floors themselves; the scatter of
the test itself always stays on top.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, Optimum


@dataclass(frozen=True)
class NoiseLevel:
    """Standard uncertainties on top of the test's scatter (relative; shape in units of the largest entry)."""

    frequency: float
    damping: float
    shape: float

    def below(self, other: NoiseLevel) -> bool:
        """True where it is clearly below another level in some kind of datum."""
        mine = np.array([self.frequency, self.damping, self.shape])
        theirs = np.array([other.frequency, other.damping, other.shape])
        return bool(np.any(mine < 0.8 * theirs))

    def applied(self, settings: FitSettings) -> FitSettings:
        """Fit settings with these floors."""
        return settings.model_copy(
            update={
                "frequency_floor": self.frequency,
                "damping_floor": self.damping,
                "shape_floor": self.shape,
            }
        )


def floors(settings: FitSettings) -> NoiseLevel:
    """The floors of the settings as a noise level."""
    return NoiseLevel(settings.frequency_floor, settings.damping_floor, settings.shape_floor)


def estimate_noise(problem: FitProblem, found: Optimum, least: float) -> NoiseLevel:
    """Noise level from the residuals of the modes that a fit explains.

    Parameters
    ----------
    problem : FitProblem
        With the floors as uncertainties.
    found : Optimum
    least : float
        Least share of the floors.

    Notes
    -----
    Each kind of datum has its own level. Fitted parameters use up data; they are taken off the kind that determines
    them: the damping ratio off the damping, the rest off the frequencies, at most half of these.
    """
    pairs = problem.assignments(found.x)
    residuals = problem.exact(pairs).residuals(found.x[None])
    squares, counts = np.zeros(3), np.zeros(3)
    start = 0
    for e, p, r in zip(problem.evidence, pairs, residuals, strict=True):
        inlier = found.inlier[start : start + p.size]
        start += p.size
        use = (p >= 0) & (inlier > 0.5)
        squares += [np.sum(r[0, use, 0] ** 2), np.sum(r[0, use, 1] ** 2), np.sum(r[0, use, 2:-1] ** 2)]
        with_damping = (e.damping_weight > 0) & use
        counts += [use.sum(), with_damping.sum(), np.sum(e.shape_counts[use])]
    fitted = min(len(problem.space.names) - 1, counts[0] / 2)
    dof = counts - [fitted, min(1.0, counts[1] / 2), 0.0]
    level = np.sqrt(squares / np.maximum(dof, 1.0))
    # With few data an estimate by chance small is not trusted.
    level = np.where(counts > 3, level * (1 + 1 / np.maximum(dof, 1.0)), 1.0)
    share = np.clip(level, least, 1.0)
    s = problem.settings
    return NoiseLevel(
        float(s.frequency_floor * share[0]),
        float(s.damping_floor * share[1]),
        float(s.shape_floor * share[2]),
    )
