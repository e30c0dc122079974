"""Unknowns with zero-mean Gaussian priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

LARGEST_STEP = 0.5
"""Largest change of an unknown in one step: most unknowns are logarithms, whose problem is linear for about as far."""


@dataclass(frozen=True)
class Unknowns:
    """Unknowns x with independent priors N(0, s²), s = std · scatter.

    Attributes
    ----------
    names : tuple of str
    std : ndarray, (n,)
        Prior 1 σ; in units of the scatter that governs it where there is one.
    scatter : tuple of str
        Name of the scatter (a hyper-parameter) that multiplies `std`; empty where `std` stands alone.
    lower, upper : ndarray, (n,)
        Bounds; infinite where there is none.
    sizes : frozenset of str
        Names of those that are sizes of effects.
    """

    names: tuple[str, ...]
    std: NDArray[np.float64]
    scatter: tuple[str, ...]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    sizes: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def plain(
        cls,
        names: Sequence[str],
        std: Sequence[float] | NDArray[np.float64] | float,
        scatter: str = "",
        lower: float | NDArray[np.float64] = -np.inf,
        upper: float | NDArray[np.float64] = np.inf,
    ) -> Unknowns:
        """Unknowns that one scatter governs, or none."""
        n = len(names)

        def full(values: object) -> NDArray[np.float64]:
            return np.array(np.broadcast_to(np.asarray(values, float), (n,)))

        return cls(tuple(names), full(std), (scatter,) * n, full(lower), full(upper))

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of every name."""
        return {name: i for i, name in enumerate(self.names)}

    def governed(self, scatter: str) -> NDArray[np.bool_]:
        """Mask of the unknowns that a scatter governs, (n,)."""
        return np.array([s == scatter for s in self.scatter], bool)

    def prior_std(self, scatters: Mapping[str, float]) -> NDArray[np.float64]:
        """Prior 1 σ at these scatters, (n,)."""
        return self.std * np.array([scatters[s] if s else 1.0 for s in self.scatter])

    def with_values(self, x: NDArray[np.float64], values: Mapping[str, float]) -> NDArray[np.float64]:
        """`x` with other values of some unknowns, by name, (n,)."""
        found = x.copy()
        found[[self.index[name] for name in values]] = list(values.values())
        return found

    def only(self, kept: Sequence[int]) -> Unknowns:
        """Some of them, by their positions."""
        return Unknowns(
            tuple(self.names[i] for i in kept),
            self.std[kept],
            tuple(self.scatter[i] for i in kept),
            self.lower[kept],
            self.upper[kept],
            self.sizes,
        )

    def clipped(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """`x` within the bounds."""
        return np.clip(x, self.lower, self.upper)


def joined(*parts: Unknowns) -> Unknowns:
    """All unknowns of several blocks, in their order."""
    return Unknowns(
        names=tuple(n for p in parts for n in p.names),
        std=np.concatenate([p.std for p in parts]),
        scatter=tuple(s for p in parts for s in p.scatter),
        lower=np.concatenate([p.lower for p in parts]),
        upper=np.concatenate([p.upper for p in parts]),
        sizes=frozenset().union(*(p.sizes for p in parts)),
    )
