"""A function of a point that keeps its last value: one step of a search asks for the same point several times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


class Remembered(Generic[T]):
    """``compute(x)``, computed anew only where x is not the last one.

    Parameters
    ----------
    compute : callable
        Of a point, (P,); its value must not be changed by the caller.
    """

    def __init__(self, compute: Callable[[NDArray[np.float64]], T]) -> None:
        self._compute = compute
        self._last: tuple[bytes, T] | None = None

    def __call__(self, x: NDArray[np.float64]) -> T:
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self._compute(x))
        return self._last[1]
