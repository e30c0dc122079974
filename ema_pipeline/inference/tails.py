"""Blocks of values that may be wrong together: the multivariate t distribution.

Identified shapes are good but for a few, of close modes and of hits that differ, which are far off as a whole. A
Gaussian would let those few speak for all.

References
----------
K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am. Stat. Assoc. 84 (1989) 881-896.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

Real = NDArray[np.float64]

TAIL = 4.0
"""Degrees of freedom."""


def cost(squares: Real, n: Real) -> Real:
    """-log density of n values by their sum of squares, up to that of n standard Gaussian ones at 0."""
    constant = gammaln((TAIL + n) / 2) - gammaln(TAIL / 2) - 0.5 * n * np.log(TAIL / 2)
    return np.asarray(0.5 * (TAIL + n) * np.log1p(squares / TAIL) - constant)


def weight(squares: Real, n: Real) -> Real:
    """Factor on the squares of a Gaussian with the same slope of the density at this point."""
    return np.asarray((TAIL + n) / (TAIL + squares))


def deviance(squares: Real, n: Real) -> Real:
    """Squares in which errors count: n where the sum of squares is n, growing with its logarithm."""
    return np.asarray(n * np.log1p(squares / TAIL) / np.log1p(n / TAIL))
