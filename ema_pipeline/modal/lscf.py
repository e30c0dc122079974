"""Common-denominator LSCF: one polynomial for all FRFs, poles of all orders.

References
----------
Guillaume, Verboven & Vanlanduit, "Frequency-domain maximum likelihood identification of modal parameters with
confidence intervals", ISMA 23, 1998.
Verboven, "Frequency-domain system identification for modal analysis", PhD thesis, VUB, 2002, 5.3.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.normal_equations import fractions, normal_equations
from ema_pipeline.modal.roots import stable_roots


def common_denominator_poles(
    frf: NDArray[np.complex128],
    omega_step: float,
    first_line: int,
    n_grid: int,
    orders: list[int],
) -> list[NDArray[np.complex128]]:
    """Stable poles with positive frequency of every order.

    Parameters
    ----------
    frf : complex ndarray, (n_frfs, n_lines)
        On lines ``first_line``, ``first_line + 1``, …; noise of all rows alike.
    omega_step : float
        Distance of lines, rad/s.
    first_line : int
        Number of the first line, counted from the frequency that maps to θ = 0.
    n_grid : int
        Number of the line that maps to θ = π.
    orders : list of int
        Polynomial orders (twice the number of modes), ascending.

    Returns
    -------
    list of complex ndarray
        Poles s in rad/s, counted from the frequency that maps to θ = 0, by rising frequency. With
        `first_line` counted from 0 Hz and `n_grid` the last line these are the poles of sdypy-EMA's LSCF at
        half the order.
    """
    equations = normal_equations(frf[:, None, :], np.ones(frf.shape[1]), max(orders), first_line, n_grid)
    coefficients = [f.denominator[:, 0, 0] for f in fractions(equations, orders)]
    step = np.pi / (n_grid * omega_step)
    out: list[NDArray[np.complex128]] = []
    for z in stable_roots(coefficients):
        pole = np.asarray(-np.log(z) / step, dtype=np.complex128)
        out.append(pole[np.argsort(pole.imag)])
    return out
