"""A problem in which what scatters lies no further out than scatter reaches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import Problem

FURTHEST = 4.0
"""Standard deviations that scatter reaches: of 400 healthy rigs of 40 parts, one has a part further out."""


class Bounded:
    """A problem with some of its scattering unknowns bound to `FURTHEST` standard deviations.

    Parameters
    ----------
    problem : Problem
    scatters : dict of str to float
        Hyper-parameters that the standard deviations follow.
    bound : sequence of str
        Scatters whose unknowns are bound.
    """

    def __init__(self, problem: Problem, scatters: Mapping[str, float], bound: Sequence[str]) -> None:
        u = problem.unknowns
        most = np.where(_governed_by(u.scatter, bound), FURTHEST * u.prior_std(scatters), np.inf)
        self.unknowns = replace(u, lower=np.maximum(u.lower, -most), upper=np.minimum(u.upper, most))
        self.residuals = problem.residuals


def beyond_scatter(found: Posterior, bound: Sequence[str], reach: float = FURTHEST) -> NDArray[np.bool_]:
    """Mask of the unknowns of some scatters that lie further out than `reach` standard deviations, (n,)."""
    far = np.abs(found.x) > reach * found.prior_std
    return np.asarray(far & _governed_by(found.unknowns.scatter, bound))


def _governed_by(scatter: Sequence[str], names: Sequence[str]) -> NDArray[np.bool_]:
    return np.array([s in names for s in scatter], bool)
