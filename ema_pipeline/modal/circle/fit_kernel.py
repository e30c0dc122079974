"""Compiled loops of the circle fit: a test has hundreds of circles of a few dozen points."""

from __future__ import annotations

from math import atan2, cos, exp, hypot, log, sin

import numba
import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

_SWEEP_STEPS, _SWEEP_ENOUGH = 40, 1e-9
_CIRCLE_STEPS, _CIRCLE_ENOUGH = 30, 1e-10
_SMALLEST_DAMPING = 1e-6


@numba.njit("boolean(float64[:, ::1], float64[::1], float64[::1])", cache=True, nogil=True)
def _solved(matrix: Real, right: Real, out: Real) -> bool:
    """Solve a small positive definite system by Cholesky; the lower half is overwritten. False where it is not."""
    n = right.size
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > 0:
                matrix[i, i] = rest**0.5
            else:
                return False
    for i in range(n):
        out[i] = right[i]
        for k in range(i):
            out[i] -= matrix[i, k] * out[k]
        out[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            out[i] -= matrix[k, i] * out[k]
        out[i] /= matrix[i, i]
    return True


@numba.njit(
    "float64(float64[::1], complex128[::1], float64[::1], float64[::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def _angles(f: Real, unit: Complex, weights: Real, p: Real, x: Real, error: Real) -> float:
    """Fill in the sweep and the errors of the angles, (n_points,); their weighted sum of squares."""
    f_n, zeta, cost = exp(p[0]), exp(p[1]), 0.0
    re, im = cos(p[2]), -sin(p[2])
    for k in range(f.size):
        ratio = f[k] / f_n
        x[k] = (ratio - 1 / ratio) / (2 * zeta)
        # 2 arctan x as a phase factor: angles never need unwrapping
        ahead, aside = 1 - x[k] * x[k], 2 * x[k]
        a = unit[k].real * ahead - unit[k].imag * aside
        b = unit[k].real * aside + unit[k].imag * ahead
        error[k] = atan2(a * im + b * re, a * re - b * im)
        cost += weights[k] * error[k] ** 2
    return cost


@numba.njit("void(float64[::1], complex128[::1], float64[::1], float64[::1])", cache=True, nogil=True)
def fit_sweep(f: Real, unit: Complex, weights: Real, p: Real) -> None:
    """Least squares of the angles on θ = phase - 2 arctan x; Levenberg-Marquardt.

    Parameters
    ----------
    f : ndarray, (n_points,)
        Hz.
    unit : complex ndarray, (n_points,)
        Unit vectors from the centre to the points.
    weights : ndarray, (n_points,)
    p : ndarray, (3,)
        ln f_n, ln ζ and phase: the start, and then the result.
    """
    x, error = np.empty(f.size), np.empty(f.size)
    x_trial, error_trial = np.empty(f.size), np.empty(f.size)
    trial, gradient, step, by, normal = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    low, high = log(f[0]), log(f[-1])
    damping = 1e-4
    cost = _angles(f, unit, weights, p, x, error)
    for _ in range(_SWEEP_STEPS):
        f_n, zeta = exp(p[0]), exp(p[1])
        for i in range(3):
            gradient[i] = 0.0
            for j in range(3):
                normal[i, j] = 0.0
        by[2] = 1.0
        for k in range(f.size):
            bend, ratio = 2 / (1 + x[k] * x[k]), f[k] / f_n
            by[0], by[1] = bend * (ratio + 1 / ratio) / (2 * zeta), bend * x[k]
            for i in range(3):
                gradient[i] += weights[k] * by[i] * error[k]
                for j in range(i + 1):
                    normal[i, j] += weights[k] * by[i] * by[j]
        for i in range(3):
            # scaled by the diagonal (Marquardt): frequency is far better determined than the rest
            normal[i, i] *= 1 + damping
        if not _solved(normal, gradient, step):
            break
        trial[0] = min(max(p[0] + step[0], low), high)
        trial[1] = min(max(p[1] + step[1], log(_SMALLEST_DAMPING)), 0.0)
        trial[2] = p[2] + step[2]
        cost_trial = _angles(f, unit, weights, trial, x_trial, error_trial)
        done = max(abs(trial[0] - p[0]), abs(trial[1] - p[1]), abs(trial[2] - p[2])) < _SWEEP_ENOUGH
        if cost_trial <= cost:
            cost, damping = cost_trial, damping * 0.1
            for i in range(3):
                p[i] = trial[i]
            x, x_trial, error, error_trial = x_trial, x, error_trial, error
        else:
            damping *= 10
        if done:
            break


@numba.njit("float64(complex128[::1], float64[::1], complex128, float64[::1])", cache=True, nogil=True)
def _distances(points: Complex, weights: Real, centre: complex, distance: Real) -> float:
    """Fill in the distances from a centre less their mean, (n_points,); their weighted sum of squares."""
    mean, cost = 0.0, 0.0
    for k in range(points.size):
        distance[k] = hypot(points[k].real - centre.real, points[k].imag - centre.imag)
        mean += weights[k] * distance[k]
    for k in range(points.size):
        distance[k] -= mean
        cost += weights[k] * distance[k] ** 2
    return cost


@numba.njit("complex128(complex128[::1], float64[::1], complex128, float64)", cache=True, nogil=True)
def best_centre(points: Complex, weights: Real, centre: complex, radius: float) -> complex:
    """Centre of the circle with the least weighted sum of squared distances; Gauss-Newton with step control.

    Parameters
    ----------
    points : complex ndarray, (n_points,)
    weights : ndarray, (n_points,)
        Adding up to 1.
    centre, radius
        Where to begin.
    """
    error, error_trial = np.empty(points.size), np.empty(points.size)
    gradient, step, normal = np.empty(2), np.empty(2), np.empty((2, 2))
    unit = np.empty(points.size, dtype=np.complex128)
    damping, cost = 1e-4, _distances(points, weights, centre, error)
    for _ in range(_CIRCLE_STEPS):
        middle = 0j
        for k in range(points.size):
            off = points[k] - centre
            unit[k] = off / max(hypot(off.real, off.imag), 1e-12 * radius)
            middle += weights[k] * unit[k]
        gradient[0] = gradient[1] = normal[0, 0] = normal[1, 0] = normal[1, 1] = 0.0
        for k in range(points.size):
            # with the best radius for each centre, only the centre is left to find
            slope = unit[k] - middle
            gradient[0] += weights[k] * slope.real * error[k]
            gradient[1] += weights[k] * slope.imag * error[k]
            normal[0, 0] += weights[k] * slope.real * slope.real
            normal[1, 0] += weights[k] * slope.real * slope.imag
            normal[1, 1] += weights[k] * slope.imag * slope.imag
        trace = normal[0, 0] + normal[1, 1]
        normal[0, 0] += damping * trace
        normal[1, 1] += damping * trace
        if not _solved(normal, gradient, step):
            break
        trial = centre + complex(step[0], step[1])
        cost_trial = _distances(points, weights, trial, error_trial)
        done = hypot(step[0], step[1]) < _CIRCLE_ENOUGH * radius
        if cost_trial <= cost:
            centre, cost, damping = trial, cost_trial, damping * 0.1
            error, error_trial = error_trial, error
        else:
            damping *= 10
        if done:
            break
    return centre
