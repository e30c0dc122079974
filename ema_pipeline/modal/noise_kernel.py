"""The compiled loops of `noise.fit_law`: sums over the lines of one output and input at a time.

Between two nodes the hat functions are straight lines, so a sum against all of them takes two sums per interval. The
variance of a line is made where it is used: nothing as large as the FRFs is kept.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

_loop = numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
"""Compiled to vector instructions: with Python's rules a division by zero would have to be looked for."""


@_loop
def quiet_lines(
    power: Real, response: Complex, measured: NDArray[np.bool_], least: float, floor: Real, quiet: Real
) -> None:
    """Least noise of every FRF, and the mean logarithm of its squared errors.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared errors; NaN or 0 where unknown.
    response : complex ndarray, (n_rows, n_references, n_lines)
    measured : ndarray of bool, (n_rows, n_references)
    least : float
        Least noise power over mean power.
    floor, quiet : ndarray, (n_rows, n_references)
        Made; the mean is 0 where no error is known.
    """
    for o in range(power.shape[0]):
        for i in range(power.shape[1]):
            floor[o, i], quiet[o, i] = least, 0.0
            if not measured[o, i]:
                continue
            z, h = np.ascontiguousarray(power[o, i]), np.ascontiguousarray(response[o, i])
            square = 0.0
            for k in range(h.size):
                square += h[k].real ** 2 + h[k].imag ** 2
            floor[o, i] *= square / h.size
            total, known = 0.0, 0
            for k in range(z.size):
                if (z[k] > 0.0) & (z[k] < np.inf):
                    total += np.log(max(z[k], floor[o, i]))
                    known += 1
            if known:
                quiet[o, i] = total / known


@_loop
def slopes(
    power: Real,
    response: Complex,
    measured: NDArray[np.bool_],
    floor: Real,
    alpha: Real,
    shape: Real,
    level: Real,
    starts: NDArray[np.int64],
    spacing: float,
    out: Real,
) -> None:
    """Derivatives of the likelihood by the variance, less and more, summed over lines against the hats.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared errors; NaN or 0 where unknown.
    response : complex ndarray, (n_rows, n_references, n_lines)
    measured : ndarray of bool, (n_rows, n_references)
    floor, level : ndarray, (n_rows, n_references)
    alpha, shape : ndarray, (n_rows, n_references, n_nodes)
    starts : ndarray of int, (n_intervals + 1,)
        First line of every interval between nodes, and one past the last line.
    spacing : float
        Lines between nodes.
    out : ndarray, (4, n_rows, n_references, n_nodes)
        Made: less and more times |H|², then less and more alone.
    """
    out[:] = 0.0
    n_nodes, step = alpha.shape[2], 1.0 / spacing
    for o in range(power.shape[0]):
        for i in range(power.shape[1]):
            if not measured[o, i]:
                continue
            least = floor[o, i]
            for j in range(starts.size - 1):
                lines = slice(starts[j], starts[j + 1])
                # side by side in memory, so that several lines are taken at once
                z = np.ascontiguousarray(power[o, i, lines])
                h = np.ascontiguousarray(response[o, i, lines])
                after = min(j + 1, n_nodes - 1)
                a, da = alpha[o, i, j], alpha[o, i, after] - alpha[o, i, j]
                s = level[o, i] * shape[o, i, j] + least
                ds = level[o, i] * (shape[o, i, after] - shape[o, i, j])
                begin = starts[j] / spacing - j
                p0, p1, q0, q1, l0, l1, m0, m1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(z.size):
                    t = begin + k * step
                    square = h[k].real ** 2 + h[k].imag ** 2
                    less = 1.0 / ((a + t * da) * square + (s + t * ds))
                    more = less * less * max(z[k], least)
                    known = (z[k] > 0.0) & (z[k] < np.inf)
                    less = less if known else 0.0
                    more = more if known else 0.0
                    l0 += less
                    l1 += less * t
                    m0 += more
                    m1 += more * t
                    p0 += less * square
                    p1 += less * square * t
                    q0 += more * square
                    q1 += more * square * t
                for row, (near, far) in enumerate(((p0, p1), (q0, q1), (l0, l1), (m0, m1))):
                    out[row, o, i, j] += near
                    if n_nodes > 1:
                        out[row, o, i, j] -= far
                        out[row, o, i, j + 1] += far
