"""What the engine asks of a problem: its unknowns, and its residuals with their derivatives at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import tails
from ema_pipeline.inference.unknowns import Unknowns


@dataclass(frozen=True)
class Apart:
    """Values, from the first on, that a model has to explain on their own as well, however many others there are.

    Attributes
    ----------
    values, projected, unknowns : int
        Their number, how many of them were spent on factors of no interest, and the number of the unknowns, from the
        first on, whose priors belong to them.
    rough : bool
        True where they, too, are calculated to first order only: they need not be explained on their own.
    """

    values: int
    projected: int
    unknowns: int
    rough: bool = False


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
        Number of measured modes among them, without those that may be none of the structure.
    split : float
        Part of the penalty that is for these others: doubles, and what a nonlinearity may have made.
    projected : int
        Number of values that were spent on factors of no interest (one per shape).
    relative : ndarray, (m,), optional
        σ over the σ that was measured or stated, in which errors count where data have one; 1 where left out.
    block : ndarray of int, (m,), optional
        Number of the block of values that may be wrong together, -1 for values on their own; see `tails`.
    mixed : ndarray of bool, (m,), optional
        True for values of shapes that identification may have mixed with another's.
    mode : ndarray of int, (m,), optional
        Measured mode that each value belongs to, numbered through all data; -1 for none.
    blurred : ndarray of bool, (m,), optional
        True for values of shapes that hold more than what they are compared with, by a mode without a partner.
    beside : ndarray of bool, (m,), optional
        True for values that may speak against a model and not for it: what they do not exceed makes no error smaller.
        Their blocks have one value each that was spent.
    apart : Apart, optional
        The first values, where a model has to explain them on their own as well.
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
    split: float = 0.0
    projected: int = 0
    relative: NDArray[np.float64] | None = None
    block: NDArray[np.int64] | None = None
    mixed: NDArray[np.bool_] | None = None
    mode: NDArray[np.int64] | None = None
    blurred: NDArray[np.bool_] | None = None
    beside: NDArray[np.bool_] | None = None
    apart: Apart | None = None

    @property
    def stated(self) -> NDArray[np.float64]:
        """Values in units of the uncertainties that were measured or stated, (m,)."""
        return self.values if self.relative is None else self.values * self.relative

    @cached_property
    def blocks(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sum of squares and number of values of every block, (n_blocks,)."""
        return in_blocks(self.values**2, self.block)

    @property
    def mixed_blocks(self) -> NDArray[np.bool_]:
        """Mask of the blocks that hold `mixed` values, (n_blocks,)."""
        return self._blocks_of(self.mixed)

    @property
    def blurred_blocks(self) -> NDArray[np.bool_]:
        """Mask of the blocks that hold `blurred` values, (n_blocks,)."""
        return self._blocks_of(self.blurred)

    @property
    def mode_of_block(self) -> NDArray[np.int64]:
        """Measured mode of every block, (n_blocks,); their own numbers where values belong to no mode."""
        if self.mode is None or self.block is None:
            return np.arange(len(self.blocks[0]))
        inside = self.block >= 0
        found = np.zeros(len(self.blocks[0]), np.int64)
        found[self.block[inside]] = self.mode[inside]
        return found

    def _blocks_of(self, values: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        if values is None:
            return np.zeros(len(self.blocks[0]), bool)
        return np.asarray(in_blocks(values.astype(float), self.block)[0] > 0)

    @cached_property
    def weight(self) -> NDArray[np.float64]:
        """Factor on values and derivatives for which least squares have the slope of the density, (m,)."""
        factor = np.ones(len(self.values))
        if self.block is not None:
            inside = self.block >= 0
            factor[inside] = np.sqrt(tails.weight(*self.blocks))[self.block[inside]]
        return factor

    @property
    def weighted(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values, (m,), and derivatives, (m, n), as least squares take them."""
        if self.block is None:
            return self.values, self.jacobian
        return self.values * self.weight, self.jacobian * self.weight[:, None]

    @property
    def squares(self) -> float:
        """Sum of squares in which errors count."""
        alone = self.stated if self.block is None else self.stated[self.block < 0]
        deviance, (beside, count) = tails.deviance(*self.blocks), self._beside
        exceeded = float(np.sum(deviance[beside])) - count
        return float(alone @ alone) + float(np.sum(deviance[~beside])) + max(exceeded, 0.0)

    @property
    def count(self) -> int:
        """Number of data: of values that were not spent on factors of no interest, without those `beside`."""
        return len(self.values) - self.projected - self._beside[1]

    @cached_property
    def _beside(self) -> tuple[NDArray[np.bool_], int]:
        """Mask of the blocks that hold values `beside`, (n_blocks,), and the number of these that were not spent."""
        blocks = self._blocks_of(self.beside)
        return blocks, int(np.sum(self.blocks[1][blocks] - 1))

    def only_apart(self, apart: Apart) -> Residuals:
        """The values that count on their own as well, without derivatives."""
        count = apart.values
        return Residuals(
            self.values[:count],
            self.jacobian[:0],
            penalty=self.penalty,
            projected=apart.projected,
            relative=None if self.relative is None else self.relative[:count],
            block=None if self.block is None else self.block[:count],
            beside=None if self.beside is None else self.beside[:count],
        )

    @property
    def cost(self) -> float:
        """-log likelihood up to a constant; infinite where the model has no answer."""
        if not np.all(np.isfinite(self.values)):
            return float("inf")
        alone = self.values if self.block is None else self.values[self.block < 0]
        return (
            0.5 * float(alone @ alone)
            + float(np.sum(tails.cost(*self.blocks)))
            + self.log_scale
            + self.penalty
        )


def in_blocks(
    squares: NDArray[np.float64], block: NDArray[np.int64] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum of squares and number of values of every block, (n_blocks,)."""
    if block is None:
        return np.zeros(0), np.zeros(0)
    inside = block >= 0
    counts = np.bincount(block[inside])
    return np.bincount(block[inside], squares[inside]).astype(float), counts.astype(float)


def same_matching(a: object, b: object) -> bool:
    """True where two assignments of data to the model, nested in any way, are the same."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same_matching(a[k], b[k]) for k in a)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(same_matching(x, y) for x, y in zip(a, b, strict=True))
    return a is b or bool(a == b)


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
