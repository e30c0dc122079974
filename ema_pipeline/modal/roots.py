"""Roots of the denominators of all orders that can be poles: stable, and below the Nyquist frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def stable_roots(coefficients: list[NDArray[np.float64]]) -> list[NDArray[np.complex128]]:
    """Roots with |z| > 1 and −π < arg z < 0 of real polynomials.

    Parameters
    ----------
    coefficients : list of ndarray
        Ascending powers, the highest coefficient 1.
    """
    out = []
    for c in coefficients:
        z = np.roots(c[::-1])
        out.append(z[(z.imag < 0) & (np.abs(z) > 1)])
    return out
