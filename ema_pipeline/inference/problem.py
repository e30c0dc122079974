"""What the engine asks of a problem: its unknowns, and its residuals with their derivatives at a point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference.unknowns import Unknowns


@dataclass(frozen=True)
class Residuals:
    """Differences of measurement and model at one point, in units of their standard uncertainties.

    Attributes
    ----------
    values : ndarray, (m,)
        (measurement - model)/σ.
    jacobian : ndarray, (m, n)
        Their derivatives by the unknowns; (0, n) where none were asked for.
    share : dict of str to ndarray, (m,)
        Share of each σ² that a scatter contributes (0 where it has no part in it): σ² = own² + Σ (scatter·unit)².
    log_scale : float
        Σ ln(σ/σ₀), σ₀ being the uncertainty at the default scatters: the price of wider uncertainties.
    penalty : float
        Further cost, in units of the log posterior: measured modes that the model does not explain.
    unexplained : int
        Number of measured modes among them.
    projected : int
        Number of values that were spent on factors of no interest (one per shape).
    relative : ndarray, (m,), optional
        σ over the σ that was measured or stated; 1 where left out.
    tail : ndarray, (m,), optional
        Factor on stated values in which errors count, below 1 for values far out on the tail of a distribution that
        has them; 1 where left out.
    matching : object
        Whatever the problem wants to have back to evaluate the same assignment of data to model again.
    """

    values: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    share: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    log_scale: float = 0.0
    penalty: float = 0.0
    matching: object = None
    unexplained: int = 0
    projected: int = 0
    relative: NDArray[np.float64] | None = None
    tail: NDArray[np.float64] | None = None

    @property
    def stated(self) -> NDArray[np.float64]:
        """Values in units of the uncertainties that were measured or stated, (m,)."""
        return self.values if self.relative is None else self.values * self.relative

    @property
    def in_error(self) -> NDArray[np.float64]:
        """Factor that turns values into those in which errors count, (m,)."""
        factor = np.ones(len(self.values))
        for one in (self.relative, self.tail):
            factor = factor if one is None else factor * one
        return factor

    @property
    def cost(self) -> float:
        """-log likelihood up to a constant; infinite where the model has no answer."""
        if not np.all(np.isfinite(self.values)):
            return float("inf")
        return 0.5 * float(self.values @ self.values) + self.log_scale + self.penalty


class Problem(Protocol):
    """Data and a model with unknowns."""

    @property
    def unknowns(self) -> Unknowns:
        """The unknowns with their priors."""
        ...

    def residuals(
        self,
        x: NDArray[np.float64],
        scatters: Mapping[str, float],
        *,
        heat: float = 1.0,
        matching: object = None,
        derivatives: bool = True,
    ) -> Residuals:
        """Residuals at `x`.

        Parameters
        ----------
        x : ndarray, (n,)
        scatters : dict of str to float
            Hyper-parameters.
        heat : float
            Factor ≥ 1 on the uncertainties while the fit is annealed.
        matching : object, optional
            `Residuals.matching` of an earlier call, to be kept; made anew where left out.
        derivatives : bool
            False where only the values are wanted.
        """
        ...
