"""What the diagnosis asks of a kind of observation: a problem for any list of effects, and parts to leave out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.inference import Posterior, Problem, Residuals, Scatter
from ema_pipeline.observations.size_map import SizeMap


class EffectProblem(Problem, Protocol):
    """The data and one model: the rig with a list of effects.

    A kind of data that inherits from it has no barriers, and needs no help with sizes, unless it says so.
    """

    @property
    def sizes(self) -> Mapping[str, SizeMap]:
        """How the effects' sizes follow from their unknowns, by ``id@place.name``."""
        ...

    @property
    def sole_parts(self) -> Mapping[str, tuple[str, float]]:
        """The only part of a family with its power, by the family's name: both make up the parameter's value."""
        return {}

    def start(self, sizes: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """Nominal values with the effects at `sizes`, or at their start values, (n,)."""
        ...

    def begun(self, x: NDArray[np.float64], scatters: Mapping[str, float]) -> list[NDArray[np.float64]]:
        """`x` with the sizes of the effect added last where a descent may find its way; none where it does anyway."""
        return []

    def escapes(
        self, x: NDArray[np.float64], scatters: Mapping[str, float], found: Residuals
    ) -> list[NDArray[np.float64]]:
        """Points beyond a barrier that no descent passes, where the fit at `x` looks stuck before one."""
        return []

    def sized_anew(self, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """`x` with other sizes of what is calculated in full, from which fits begin."""
        return [x]

    def uninterpolated(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The nearest point to `x` at which nothing lies between what is calculated once for all."""
        return x

    def unpaired(self, x: NDArray[np.float64], scatters: Mapping[str, float], heat: float = 1.0) -> float:
        """`Residuals.penalty` at `x`: what modes without a partner cost."""
        return self.residuals(x, scatters, heat=heat, derivatives=False).penalty

    def tuned(self, x: NDArray[np.float64], name: str) -> list[float]:
        """Unknowns of the size `name` at which a mode comes to where one was measured that has no partner at `x`."""
        return []

    def modes_added(self, x: NDArray[np.float64], further: NDArray[np.float64]) -> int:
        """Number of modes that would have been measured at `further` while there is nothing near the band at `x`, where
        none of them would find a partner.
        """
        return 0

    def first_order(
        self, found: Posterior, added: Sequence[EffectProblem]
    ) -> list[NDArray[np.float64] | None]:
        """Derivatives of the residuals of a fit by the sizes of effects that are not there, (m, k) each.

        None for what must be asked of the problem with that effect: each of `added` has one more.
        """
        return [None] * len(added)

    def parameter_values(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Values of the rig's parameters and of the effects' sizes."""
        ...


class Observations(Protocol):
    """Measured data of one kind, compared with any model: a class with `scatters`, `problem` and `folds`.

    Attributes
    ----------
    scatters : mapping of str to Scatter
        The hyper-parameters that these data depend on.
    linearised : bool
        True where effects that depend on the amplitude are known to first order, whose rest looks like another.
    level_dependent : bool
        True where modes are seen to move with the force of the hits, which no linear model does.
    slow : bool
        True where models are marched through time, or through many hits.
    """

    scatters: Mapping[str, Scatter]
    linearised: bool = False
    level_dependent: bool = False
    slow: bool = False

    def problem(self, effects: Sequence[PlacedEffect], scales: Mapping[str, float]) -> EffectProblem:
        """The problem of fitting the rig with `effects`, whose sizes have these prior 1 σ, to the data."""
        ...

    def suited(self, effects: Sequence[PlacedEffect]) -> Observations:
        """The same data for models with these effects: with unknowns that only they need. Often the same object."""
        return self

    def about(self, effects: Sequence[PlacedEffect], found: Posterior) -> Observations:
        """The same data, with what takes long found about a fit with these effects. Often the same object."""
        return self

    def in_full(
        self, effects: Sequence[PlacedEffect], found: Posterior
    ) -> tuple[Observations, Observations] | None:
        """The data with what these effects do calculated in full about a fit with them, and as well as these are known
        then with what they do to first order; None where nothing is known to first order only.
        """
        return None

    def friction_of(self, effect: PlacedEffect) -> frozenset[str]:
        """Names of the elements that an effect adds, where all are friction, which is known to first order only."""
        return frozenset()

    def folds(self) -> Sequence[tuple[Observations, Observations]]:
        """Pairs of what is fitted and what is held out: a configuration, a hit point, a level, a share of modes."""
        ...

    def holding_out_explained(self, found: Residuals) -> Observations:
        """The same data, of which folds hold out nothing that has no partner in `found`: no fit to the rest could tell
        of a mode that an effect adds. Often the same object.
        """
        return self
