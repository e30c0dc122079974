"""Marched hits about one fit of the model: at sizes on a lattice, and straight in between.

Fits of a hundred hypotheses beside teeth that part ask for the same hits at thousands of points, at which the linear
structure hardly differs: it is that of one fit for all. So every hit is marched once for each size that is asked for,
and the answer depends on no order in which that happens.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect, effect_of
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.fitting import transferred
from ema_pipeline.observations.hit_data import HitData
from ema_pipeline.observations.hit_residuals import AMPLITUDE, HitResiduals
from ema_pipeline.observations.size_map import LOG_STD

if TYPE_CHECKING:
    from ema_pipeline.observations.amplitude import AmplitudeObservations, AmplitudeProblem

Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

SPACING, _COARSE = 0.05, 0.2
"""Of the lattice, in the unknowns of sizes, of which one is the prior σ; and of what is calculated in full, whose hits
are marched to the end of their records."""
_ON = 1e-6
LEAST = 1e-6
"""Size, in its prior σ, below which a size that cannot be negative is nothing."""


class MarchedHits:
    """What effects change of the modes in single hits whose hits are marched.

    Parameters
    ----------
    observations : AmplitudeObservations
    effects : sequence of PlacedEffect
    found : Posterior
        Fit with these effects, whose structure stands for all.
    """

    def __init__(
        self, observations: AmplitudeObservations, effects: Sequence[PlacedEffect], found: Posterior
    ) -> None:
        self._observations, self._effects, self._found = observations, tuple(effects), found
        self._problems: dict[tuple[str, ...], AmplitudeProblem] = {}
        self._nodes: dict[tuple[object, ...], Complex] = {}

    def changes(self, data: HitData, problem: AmplitudeProblem, x: NDArray[np.float64]) -> Complex:
        """What effects change whose hits are marched, as `HitResiduals.moved` has it, of all or some hits."""
        names, at = self._place(problem, x)
        low = np.floor(at + _ON).astype(np.int64)
        first = self._node(data, problem, names, low)
        result = first.copy()
        for i in np.flatnonzero(at - low > _ON):
            ahead = low + (np.arange(len(low)) == i)
            result += (at[i] - low[i]) * (self._node(data, problem, names, ahead) - first)
        whole = self._whole(data)
        if len(data.names) == len(whole.names):
            return result
        place = {n: k for k, n in enumerate(whole.names)}
        return result[:, [place[n] for n in data.names]]

    @staticmethod
    def _place(problem: AmplitudeProblem, x: NDArray[np.float64]) -> tuple[list[str], NDArray[np.float64]]:
        """Unknowns that span the lattice, and where `x` lies in it.

        Larger motions are as smaller lengths, forces and rates.
        """
        names = [problem.unknowns.names[i] for i in problem.marched_sizes]
        at, scale = x[list(problem.marched_sizes)], x[problem.unknowns.index[AMPLITUDE]]
        coarse = np.array([problem.in_full(n) for n in names])
        logarithmic = np.array([problem.sizes[n].logarithmic for n in names])
        at = np.where(coarse & ~logarithmic, np.log(np.maximum(at, LEAST)) / LOG_STD, at)
        moved = np.where(logarithmic | coarse, at - scale / LOG_STD, at * np.exp(-scale))
        return names, moved / np.where(coarse, _COARSE, SPACING)

    def _whole(self, data: HitData) -> HitData:
        return next(h for h in self._observations.hits if h.configuration == data.configuration)

    def _node(self, data: HitData, problem: AmplitudeProblem, names: list[str], at: Integers) -> Complex:
        own = {e.label for e in self._effects if e.effect.linear} | {effect_of(n) for n in names}
        effects = [e for e in problem.effects if e.label in own]
        labels = tuple(e.label for e in effects)
        key = (labels, data.configuration, *at.tolist())
        if key not in self._nodes:
            if labels not in self._problems:
                self._problems[labels] = self._observations.problem(effects, problem.scales)
            self._nodes[key] = self._marched(self._whole(data), self._problems[labels], names, at)
        return self._nodes[key]

    def _marched(self, data: HitData, problem: AmplitudeProblem, names: list[str], at: Integers) -> Complex:
        posterior, unknowns = self._found, problem.unknowns
        x = transferred(posterior, unknowns, problem.start())
        for name, place in zip(names, at.tolist(), strict=True):
            x[unknowns.index[name]] = _unknown(problem, name, place)
        x[unknowns.index[AMPLITUDE]] = 0.0
        x = unknowns.clipped(x)
        paired = problem.modes.paired(data.reference, x[: len(problem.modes.unknowns)], None)
        if paired is None:
            return np.zeros((2, *data.log_frequency.shape), complex)
        return HitResiduals(problem, data, paired, x, posterior.scatters, 1.0).moved(x)


def on_lattice(problem: AmplitudeProblem, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """`x` with the lengths of teeth at the nearest place of the lattice, where nothing is interpolated, (n,).

    Every length that lies between two places costs another march of all hits.
    """
    lengths = [i for i in problem.marched_sizes if not problem.in_full(problem.unknowns.names[i])]
    moved = x[problem.unknowns.index[AMPLITUDE]] / LOG_STD
    x = x.copy()
    x[lengths] = np.rint((x[lengths] - moved) / SPACING) * SPACING + moved
    return problem.unknowns.clipped(x)


def _unknown(problem: AmplitudeProblem, name: str, place: int) -> float:
    """The unknown of a size at a place of the lattice."""
    if not problem.in_full(name):
        return place * SPACING
    at = place * _COARSE
    return at if problem.sizes[name].logarithmic else float(np.exp(at * LOG_STD))
