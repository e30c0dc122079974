"""The compiled loops of `noise.fit_law`: sums over the lines of one output and input at a time.

Between two nodes the hat functions are straight lines, so a sum against all of them takes two sums per interval. The
variance of a line is made where it is used: nothing as large as the FRFs is kept.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

_REAL, _FLAG = numba.float64, numba.boolean


def _read(kind: numba.types.Type, dimensions: int) -> numba.types.Array:
    return numba.types.Array(kind, dimensions, "A", readonly=True)


def _made(dimensions: int) -> numba.types.Array:
    return numba.types.Array(_REAL, dimensions, "A")


_DATA = (_read(_REAL, 3), _read(_REAL, 3), _read(_FLAG, 2))
"""Squared errors, squared FRFs, and which were measured. One type for arrays of any order in memory: each further one
would be compiled by itself, for a second or two."""


def _loop(*arguments: numba.types.Type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Compiled to vector instructions: with Python's rules a division by zero would have to be looked for."""
    return numba.njit(
        numba.void(*arguments),
        cache=True,
        nogil=True,
        fastmath={"reassoc", "contract", "nsz"},
        error_model="numpy",
    )


@_loop(*_DATA, _REAL, _made(2), _made(2))
def quiet_lines(
    power: Real, square: Real, measured: NDArray[np.bool_], least: float, floor: Real, quiet: Real
) -> None:
    """Least noise of every FRF, and the mean logarithm of its squared errors.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared errors; NaN or 0 where unknown.
    square : ndarray, (n_rows, n_references, n_lines)
        |H|².
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
            z, h = np.ascontiguousarray(power[o, i]), np.ascontiguousarray(square[o, i])
            floor[o, i] *= h.sum() / h.size
            total, known = 0.0, 0
            for k in range(z.size):
                if (z[k] > 0.0) & (z[k] < np.inf):
                    total += np.log(max(z[k], floor[o, i]))
                    known += 1
            if known:
                quiet[o, i] = total / known


@_loop(
    *_DATA, _read(_REAL, 2), _read(_REAL, 3), _read(_REAL, 3), _read(_REAL, 2),
    _read(numba.int64, 1), _REAL, _FLAG, _made(4),
)  # fmt: skip
def slopes(
    power: Real,
    square: Real,
    measured: NDArray[np.bool_],
    floor: Real,
    alpha: Real,
    shape: Real,
    level: Real,
    starts: NDArray[np.int64],
    spacing: float,
    common: bool,
    out: Real,
) -> None:
    """Derivatives of the likelihood by the variance, less and more, summed over lines against the hats.

    Parameters
    ----------
    power : ndarray, (n_rows, n_references, n_lines)
        Squared errors; NaN or 0 where unknown.
    square : ndarray, (n_rows, n_references, n_lines)
        |H|².
    measured : ndarray of bool, (n_rows, n_references)
    floor, level : ndarray, (n_rows, n_references)
    alpha, shape : ndarray, (n_rows, n_references, n_nodes)
    starts : ndarray of int, (n_intervals + 1,)
        First line of every interval between nodes, and one past the last line.
    spacing : float
        Lines between nodes.
    common : bool
        True for the derivatives by the common share, times |H|²; False for those by the own share.
    out : ndarray, (2, n_rows, n_references, n_nodes)
        Made: less and more.
    """
    out[:] = 0.0
    n_nodes, step = alpha.shape[2], 1.0 / spacing
    for o in range(power.shape[0]):
        for i in range(power.shape[1]):
            if not measured[o, i]:
                continue
            least = floor[o, i]
            # side by side in memory, so that several lines are taken at once
            errors, row = np.ascontiguousarray(power[o, i]), np.ascontiguousarray(square[o, i])
            for j in range(starts.size - 1):
                z, h = errors[starts[j] : starts[j + 1]], row[starts[j] : starts[j + 1]]
                after, begin = min(j + 1, n_nodes - 1), starts[j] * step - j
                da = (alpha[o, i, after] - alpha[o, i, j]) * step
                ds = level[o, i] * (shape[o, i, after] - shape[o, i, j]) * step
                a = alpha[o, i, j] + begin * spacing * da
                s = level[o, i] * shape[o, i, j] + least + begin * spacing * ds
                l0, l1, m0, m1 = 0.0, 0.0, 0.0, 0.0
                if common:
                    for k in range(z.size):
                        less = 1.0 / ((a + k * da) * h[k] + (s + k * ds))
                        more = less * less * max(z[k], least)
                        known = (z[k] > 0.0) & (z[k] < np.inf)
                        less = less * h[k] if known else 0.0
                        more = more * h[k] if known else 0.0
                        l0 += less
                        l1 += less * k
                        m0 += more
                        m1 += more * k
                else:
                    for k in range(z.size):
                        less = 1.0 / ((a + k * da) * h[k] + (s + k * ds))
                        more = less * less * max(z[k], least)
                        known = (z[k] > 0.0) & (z[k] < np.inf)
                        less = less if known else 0.0
                        more = more if known else 0.0
                        l0 += less
                        l1 += less * k
                        m0 += more
                        m1 += more * k
                for part, (all_, moment) in enumerate(((l0, l1), (m0, m1))):
                    far = begin * all_ + step * moment
                    out[part, o, i, j] += all_
                    if n_nodes > 1:
                        out[part, o, i, j] -= far
                        out[part, o, i, j + 1] += far
