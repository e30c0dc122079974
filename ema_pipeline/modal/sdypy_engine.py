"""The LSCF of sdypy-EMA as an engine, for comparison.

Its frequency axis must start at 0 Hz and a large ratio of the band's ends spoils its conditioning; so it
gets the lines of a sub-band as if they began a few lines above 0 Hz.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

SAFE_PRODUCT = 5.0
"""Largest product of polynomial order and lower over upper end of the band; poles go wrong from about 8."""


def sdypy_poles(
    omega: NDArray[np.float64], frf: NDArray[np.complex128], highest: int
) -> list[NDArray[np.complex128]]:
    """Poles of the orders 1 … `highest` (number of modes) inside a band, rad/s.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
        Equally spaced, rad/s.
    frf : complex ndarray, (n_frfs, n_lines)
    highest : int
    """
    from sdypy import EMA

    n = len(omega)
    step = float(omega[1] - omega[0])
    shift = max(1, int(SAFE_PRODUCT * n / (2 * highest)))  # lines below the band
    frequency = np.arange(shift + n + 1) * step / (2 * np.pi)
    padded = np.zeros((len(frf), len(frequency)), dtype=np.complex128)
    padded[:, shift : shift + n] = frf
    padded[:, -1] = frf[:, -1]  # the model leaves out its last line
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = EMA.Model(
            padded, frequency, lower=frequency[shift], upper=frequency[-1], pol_order_high=int(highest)
        )
        model.get_poles(method="lscf", show_progress=False)
    offset = 1j * (omega[0] - shift * step)
    return [np.asarray(p)[np.imag(p) > 0] + offset for p in model.all_poles]
