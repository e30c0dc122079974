"""Fourier series of a periodic displacement, in cycles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def fourier(phase: NDArray[np.float64], harmonics: int) -> NDArray[np.float64]:
    """1, cos, sin of the harmonics at phases in cycles, (n, 2·harmonics + 1)."""
    angle = 2 * np.pi * np.outer(phase, np.arange(1, harmonics + 1))
    return np.hstack([np.ones((len(phase), 1)), np.cos(angle), np.sin(angle)])


def fourier_slope(phase: NDArray[np.float64], harmonics: int) -> NDArray[np.float64]:
    """Derivatives of `fourier` by phase in cycles."""
    order = 2 * np.pi * np.arange(1, harmonics + 1)
    angle = np.outer(phase, order)
    return np.hstack([np.zeros((len(phase), 1)), -order * np.sin(angle), order * np.cos(angle)])
