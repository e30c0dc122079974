"""Poles of all model orders, as every engine hands them to the selection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PoleSet:
    """Poles with positive frequency inside a band, sorted by order.

    Attributes
    ----------
    order : ndarray of int, (n_poles,)
        Order of the model that the pole belongs to.
    pole : complex ndarray, (n_poles,)
        rad/s.
    shape : complex ndarray, (n_poles, n_rows)
        Shape at the rows, any scale.
    participation : complex ndarray, (n_poles, n_references)
        Participation factors, any scale.
    orders : tuple of int
        All orders that were computed, also those without a pole in the band.
    """

    order: NDArray[np.int64]
    pole: NDArray[np.complex128]
    shape: NDArray[np.complex128]
    participation: NDArray[np.complex128]
    orders: tuple[int, ...]

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """|s|/2π."""
        return np.asarray(np.abs(self.pole) / (2 * np.pi))

    @property
    def damping_ratio(self) -> NDArray[np.float64]:
        """−Re s/|s|."""
        return np.asarray(-self.pole.real / np.abs(self.pole))

    def take(self, keep: NDArray[np.bool_]) -> PoleSet:
        """Poles where `keep` is true."""
        return PoleSet(
            self.order[keep], self.pole[keep], self.shape[keep], self.participation[keep], self.orders
        )
