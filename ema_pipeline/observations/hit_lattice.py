"""What teeth and friction change, about one fit of the model: at sizes on a lattice, and straight in between.

Fits of a hundred hypotheses beside teeth that part, or beside friction, ask for the same at thousands of points, at
which the linear structure hardly differs: it is that of one fit for all. So every hit is marched, or friction
linearised, once for each size that is asked for, and the answer depends on no order in which that happens.
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
"""Of the lattice, in the unknowns of sizes, of which one is the prior σ, of friction in their logarithm; and of what is
calculated in full, whose hits are marched to the end of their records."""
_ON = 1e-6
LEAST = 1e-6
"""Size, in its prior σ, below which a size that cannot be negative is nothing."""


class SizeLattice:
    """What effects change of the modes in single hits where their sizes are on a lattice.

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
        """What the effects on the lattice change, as `HitResiduals.moved` has it, of all or some hits."""
        found = (self._interpolated(data, problem, x, group) for group in problem.lattice_groups)
        return sum(found, np.zeros((2, 1, 1), complex))

    def _interpolated(
        self, data: HitData, problem: AmplitudeProblem, x: NDArray[np.float64], sizes: Sequence[int]
    ) -> Complex:
        """What the effects of some sizes change, by the positions of these."""
        names, at = self._place(problem, x, sizes)
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
    def _place(
        problem: AmplitudeProblem, x: NDArray[np.float64], sizes: Sequence[int]
    ) -> tuple[list[str], NDArray[np.float64]]:
        """Names of some sizes, and where `x` lies in the lattice that they span.

        Larger motions are as smaller lengths, forces and rates.
        """
        names = [problem.unknowns.names[i] for i in sizes]
        at, scale = x[list(sizes)], x[problem.unknowns.index[AMPLITUDE]]
        rubs = np.array([problem.rubs(n) for n in names])
        logarithmic = np.array([problem.sizes[n].logarithmic for n in names])
        at = np.where(rubs & ~logarithmic, np.log(np.maximum(at, LEAST)) / LOG_STD, at)
        moved = np.where(logarithmic | rubs, at - scale / LOG_STD, at * np.exp(-scale))
        return names, moved / np.array([_spacing(problem, n) for n in names])

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
            self._nodes[key] = self._calculated(self._whole(data), self._problems[labels], names, at)
        return self._nodes[key]

    def _calculated(
        self, data: HitData, problem: AmplitudeProblem, names: list[str], at: Integers
    ) -> Complex:
        posterior, unknowns = self._found, problem.unknowns
        x = transferred(posterior, unknowns, problem.start())
        for name, place in zip(names, at.tolist(), strict=True):
            x[unknowns.index[name]] = _unknown(problem, name, place)
        x[unknowns.index[AMPLITUDE]] = 0.0
        x = unknowns.clipped(x)
        paired = problem.modes.paired(data.reference, x[: len(problem.modes.unknowns)], None)
        if paired is None:
            return np.zeros((2, *data.log_frequency.shape), complex)
        here = HitResiduals(problem, data, paired, x, posterior.scatters, 1.0)
        return here.calculated(x, problem.on_lattice)


def uninterpolated(problem: AmplitudeProblem, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """`x` with the lengths of teeth at the nearest place of the lattice, where nothing is interpolated, (n,).

    Every length that lies between two places costs another march of all hits.
    """
    lengths = [i for i in problem.marched_sizes if not problem.rubs(problem.unknowns.names[i])]
    moved = x[problem.unknowns.index[AMPLITUDE]] / LOG_STD
    x = x.copy()
    x[lengths] = np.rint((x[lengths] - moved) / SPACING) * SPACING + moved
    return problem.unknowns.clipped(x)


def _spacing(problem: AmplitudeProblem, name: str) -> float:
    return _COARSE if problem.in_full(name) else SPACING


def _unknown(problem: AmplitudeProblem, name: str, place: int) -> float:
    """The unknown of a size at a place of the lattice."""
    at = place * _spacing(problem, name)
    return at if problem.sizes[name].logarithmic or not problem.rubs(name) else float(np.exp(at * LOG_STD))
