"""Triangular factors of posterior precisions, which no rounding makes impossible."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray


def lower_factor(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lower-triangular L with L·Lᵀ = I + A, of an A that is positive semidefinite but for rounding, (n, n).

    Where A exceeds 1 by the reciprocal of the machine precision, I + A has eigenvalues that rounding makes negative:
    they are set to 1, the least that they can be.

    Parameters
    ----------
    information : ndarray, (n, n)
        I + A.
    """
    try:
        return np.asarray(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        size, directions = np.linalg.eigh(0.5 * (information + information.T))
        upper = np.linalg.qr((directions * np.sqrt(np.maximum(size, 1.0))).T)[1]
        sign = np.where(np.diag(upper) < 0, -1.0, 1.0)
        return np.asarray((sign[:, None] * upper).T)


def solve_lower(factor: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """L⁻¹·b of a lower-triangular L, (n, n), and b, (n,). Empty for n = 0.

    SciPy before 1.14 refuses empty arrays, which arise where nothing was held out.
    """
    if not right.size:
        return right
    return np.asarray(scipy.linalg.solve_triangular(factor, right, lower=True, check_finite=False))
