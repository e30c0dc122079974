"""The compiled loop of `fit.weighted_grams`: products of all pairs of columns, line by line."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


@numba.njit(
    "void(float64[:, ::1], float64[:, ::1], int64, float64[:, ::1])",
    cache=True,
    nogil=True,
    fastmath={"reassoc", "contract", "nsz"},
)
def products(re: Real, im: Real, first: int, out: Real) -> None:
    """Re(conj(a) b) for all pairs of columns a and b that is not before it, nor before the column `first`.

    Parameters
    ----------
    re, im : ndarray, (n_columns, n_lines)
        In C order.
    first : int
    out : ndarray, (n_pairs, n_lines)
        Made; pairs in the order of ``numpy.triu_indices``.
    """
    row = 0
    for i in range(re.shape[0]):
        for j in range(max(i, first), re.shape[0]):
            for k in range(re.shape[1]):
                out[row, k] = re[i, k] * re[j, k] + im[i, k] * im[j, k]
            row += 1
