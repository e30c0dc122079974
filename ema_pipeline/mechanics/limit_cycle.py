"""Bouc-Wen hysteresis along a cycle that goes once up and once down, for any exponent, without stepping.

Between two turning points the state first falls to zero and then rises to the other side. Both ways are
functions of the path alone, tabulated once per shape, so that all loops are run through by interpolation.

References
----------
F. Ikhouane, J. Rodellar, *Systems with Hysteresis* (2007), chapter 3: the limit cycle of the normalised model.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_DECADES = 32.0
_TABLE = 1600


class LimitCycle:
    """Steady state of ẇ = ρ(ẋ - σ|ẋ||w|ⁿ⁻¹w + (σ - 1)ẋ|w|ⁿ) between two turning points.

    Parameters
    ----------
    sigma, exponent : float
        σ > 0, n ≥ 1.
    """

    def __init__(self, sigma: float, exponent: float) -> None:
        t = np.linspace(0.0, _DECADES, _TABLE)
        away = np.exp(-t)
        power = exponent * np.log1p(-np.minimum(away, 1 - 1e-16))
        rising = away / np.maximum(-np.expm1(power), 1e-300)
        falling = away / (1.0 + (2 * sigma - 1.0) * np.exp(power))
        self._w = 1.0 - away
        self._rise = _integral(rising, t[1])
        self._fall = _integral(falling, t[1])

    def along(self, way: NDArray[np.float64], span: NDArray[np.float64]) -> NDArray[np.float64]:
        """State after `way` from the last turning point, counted in the direction of motion, (n,).

        Parameters
        ----------
        way, span : ndarray, (n,)
            ρ times the way since the turning point, and ρ times the way between turning points.
        """
        top = np.interp(span, self._rise + self._fall, self._w)
        left = np.interp(top, self._w, self._fall) - way
        before = np.interp(np.maximum(left, 0.0), self._fall, self._w)
        after = np.interp(np.maximum(-left, 0.0), self._rise, self._w)
        return np.where(left > 0, -before, after)


def _integral(values: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Running integral, fourth order inside, (n,)."""
    part = 0.5 * (values[1:] + values[:-1])
    second = np.gradient(np.gradient(values))
    part -= (second[1:] + second[:-1]) / 24
    return np.concatenate([[0.0], np.cumsum(part * step)])
