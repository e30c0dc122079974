"""A circle through points of the complex plane.

References
----------
Chernov, N., "Circular and Linear Regression: Fitting Circles and Lines by Least Squares", CRC Press, 2010.
Taubin, G., "Estimation of planar curves, surfaces and nonplanar space curves defined by implicit equations",
IEEE Trans. PAMI 13, 1991.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.circle.fit_kernel import best_centre


def algebraic_circle(points: NDArray[np.complex128], weights: NDArray[np.float64]) -> tuple[complex, float]:
    """Taubin's circle: nearly unbiased, without iteration.

    Parameters
    ----------
    points : complex ndarray, (n,)
        At least three.
    weights : ndarray, (n,)
        Adding up to 1.

    Returns
    -------
    centre : complex
    radius : float
        Both infinite for points on a line.
    """
    middle = complex(np.sum(weights * points))
    off = points - middle
    square = off.real**2 + off.imag**2
    mean_square = float(np.sum(weights * square))
    if mean_square <= 0:
        return middle, 0.0
    columns = np.stack([(square - mean_square) / (2 * np.sqrt(mean_square)), off.real, off.imag], axis=1)
    *_, last = np.linalg.svd(columns * np.sqrt(weights)[:, None], full_matrices=False)[2]
    a = last[0] / (2 * np.sqrt(mean_square))
    if abs(a) * np.sqrt(mean_square) < 1e-12:
        return complex(np.inf, np.inf), np.inf
    centre = -complex(last[1], last[2]) / (2 * a)
    return middle + centre, float(np.sqrt(abs(centre) ** 2 + mean_square))


def geometric_circle(points: NDArray[np.complex128], weights: NDArray[np.float64]) -> tuple[complex, float]:
    """The circle with the least weighted sum of squared distances from the points.

    Gauss-Newton with step control (Levenberg-Marquardt) from Taubin's circle. Shapes, units and result as
    for `algebraic_circle`.
    """
    centre, radius = algebraic_circle(points, weights)
    if not np.isfinite(radius) or radius == 0.0:
        return centre, radius
    flat = np.ascontiguousarray(points, np.complex128), np.ascontiguousarray(weights, np.float64)
    centre = complex(best_centre(*flat, centre, radius))
    return centre, float(np.sum(weights * np.abs(points - centre)))
