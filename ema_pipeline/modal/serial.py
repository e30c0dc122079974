"""Sums of values of which neighbours may be alike, as where a rig drifts or a part of it answers differently."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


def lags(n: int) -> int:
    """Neighbours on either side that may be alike, for n values: 2 of 5, 3 of 75, 4 of 100."""
    return int(4 * (n / 100) ** (2 / 9))


def variance_of_sum(values: Real) -> Real:
    """Variance of the sum of values in the order in which they came, mean 0.

    It is the sum of squares, and products of neighbours with weights that fall over their distance. Where these are
    negative the sum of squares stands: opposite neighbours may as well be chance.

    Parameters
    ----------
    values : ndarray, (n, ...)

    Returns
    -------
    ndarray, (...)

    References
    ----------
    Newey, W. K. & West, K. D., "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent
    covariance matrix", Econometrica 55, 1987; the number of lags after their "Automatic lag selection in covariance
    matrix estimation", Review of Economic Studies 61, 1994.
    """
    n = len(values)
    squares = np.sum(values**2, axis=0)
    most = min(lags(n), n - 1)
    products = np.zeros_like(squares)
    for k in range(1, most + 1):
        products += 2 * (1 - k / (most + 1)) * np.sum(values[k:] * values[:-k], axis=0)
    return np.asarray(squares + np.maximum(products, 0.0))


def widening(values: Real) -> float:
    """How much larger the standard deviation of the mean of values is than if they did not depend on each other."""
    off = values - np.mean(values)
    squares = float(np.sum(off**2))
    return float(np.sqrt(variance_of_sum(off) / squares)) if squares > 0 else 1.0
