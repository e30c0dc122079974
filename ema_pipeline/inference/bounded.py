"""A problem in which what scatters lies no further out than scatter reaches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.posterior import Posterior
from ema_pipeline.inference.problem import Problem

FURTHEST = 4.0
"""How far one part may lie, in units of how far the others of its kind scatter: the furthest of 72 healthy rigs of 6 to
40 parts lies at 3.5."""
_DEFAULT_COUNT = 4.0
"""Parts that the default of a scatter counts as, beside those that a rig has."""


class Bounded:
    """A problem with some of its unknowns bound.

    Parameters
    ----------
    problem : Problem
    most : dict of str to float
        Largest size of these unknowns, by name.
    """

    def __init__(self, problem: Problem, most: Mapping[str, float]) -> None:
        u = problem.unknowns
        bound = np.array([most.get(name, np.inf) for name in u.names])
        self.unknowns = replace(u, lower=np.maximum(u.lower, -bound), upper=np.minimum(u.upper, bound))
        self.residuals = problem.residuals


def reach(found: Posterior, defaults: Mapping[str, float], furthest: float = FURTHEST) -> dict[str, float]:
    """How far every unknown of some scatters may lie, by name: as far as the others of its kind tell.

    A scatter that is learned with the one that stands out grows with it, until nothing stands out. Parts of which the
    data tell little stay at their means, and so tell little of how parts scatter: each counts as far as it is told.

    Parameters
    ----------
    found : Posterior
    defaults : dict of str to float
        Usual sizes of these scatters.
    furthest : float
    """
    u = found.unknowns
    limits: dict[str, float] = {}
    for kind, default in defaults.items():
        of_kind = np.flatnonzero([s == kind for s in u.scatter])
        unit = u.std[of_kind]
        squares = (found.x[of_kind] / unit) ** 2
        told = np.clip(1 - (found.std[of_kind] / found.prior_std[of_kind]) ** 2, 0.0, 1.0)
        others = np.sum(squares) - squares + _DEFAULT_COUNT * default**2
        scatter = np.sqrt(others / (_DEFAULT_COUNT + np.sum(told) - told))
        scatter = np.minimum(scatter, found.scatters.get(kind, np.inf))  # several may stand out at once
        limits |= {u.names[i]: furthest * float(s) for i, s in zip(of_kind, scatter * unit, strict=True)}
    return limits


def beyond(found: Posterior, most: Mapping[str, float]) -> NDArray[np.bool_]:
    """Mask of the unknowns that lie further out than they may, (n,)."""
    bound = np.array([most.get(name, np.inf) for name in found.unknowns.names])
    return np.asarray(np.abs(found.x) > bound)
