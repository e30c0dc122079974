"""The compiled loop of `basis.real_columns`: all functions of a pole and its conjugate, line by line."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


@numba.njit(
    "void(float64[::1], complex128[::1], float64, complex128[::1], complex128[::1], complex128[:, ::1], "
    "complex128[:, ::1])",
    cache=True,
    nogil=True,
    fastmath={"reassoc", "contract", "nsz"},
    error_model="numpy",
)
def columns_of_poles(
    omega: Real,
    poles: Complex,
    rest_s: float,
    left: Complex,
    turn: Complex,
    columns: Complex,
    slopes: Complex,
) -> None:
    """u ± u* as in `basis.real_columns`, and their derivatives by the pole.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
        rad/s.
    poles : complex ndarray, (n_poles,)
        rad/s.
    rest_s : float
        Time from the hit to the end of the record, s; 0 for a decayed record.
    left : complex ndarray, (n_poles,)
        exp(s·rest), what is left of each mode at the end; 0 for a decayed record.
    turn : complex ndarray, (n_lines,)
        exp(−jω·rest).
    columns, slopes : complex ndarray, (2·n_poles, n_lines)
        Made; slopes not where they have no rows.
    """
    with_slopes = slopes.shape[0] > 0
    for r in range(poles.size):
        a, place, lr, li = -poles[r].real, poles[r].imag, left[r].real, left[r].imag
        for k in range(omega.size):
            tr, ti = turn[k].real, turn[k].imag
            b = omega[k] - place
            size = 1.0 / (a * a + b * b)
            x, y = a * size, -b * size
            gr, gi = lr * tr - li * ti, lr * ti + li * tr
            ur, ui = (1.0 - gr) * x + gi * y, (1.0 - gr) * y - gi * x
            wr, wi = ur - rest_s * gr, ui - rest_s * gi
            dr, di = wr * x - wi * y, wr * y + wi * x
            b = omega[k] + place
            size = 1.0 / (a * a + b * b)
            x, y = a * size, -b * size
            gr, gi = lr * tr + li * ti, lr * ti - li * tr
            vr, vi = (1.0 - gr) * x + gi * y, (1.0 - gr) * y - gi * x
            wr, wi = vr - rest_s * gr, vi - rest_s * gi
            er, ei = wr * x - wi * y, wr * y + wi * x
            columns[2 * r, k] = complex(ur + vr, ui + vi)
            columns[2 * r + 1, k] = complex(vi - ui, ur - vr)
            if with_slopes:
                slopes[2 * r, k] = complex(dr + er, di + ei)
                slopes[2 * r + 1, k] = complex(ei - di, dr - er)
