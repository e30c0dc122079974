"""From ideal signals to what the analyser stores: volts with noise, offset, clipping and quantisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CLIPPED_AT = 0.7
"""An overloaded hammer channel clips at this share of its peak."""


def record_channel(
    signal: NDArray[np.float64],
    sensitivity_mv: float,
    noise: float,
    offset_v: float,
    converter_bits: int,
    converter_range_v: float,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Volts of one channel.

    Parameters
    ----------
    signal : ndarray, (n_samples,)
        In the sensor's unit.
    sensitivity_mv : float
        mV per unit.
    noise : float
        Standard deviation of white noise, in the sensor's unit.
    offset_v : float
        DC offset, V.
    converter_bits : int
    converter_range_v : float
        The converter carries ± this voltage.
    random : numpy Generator

    Returns
    -------
    ndarray, (n_samples,)
    """
    volts = 1e-3 * sensitivity_mv * (signal + noise * random.standard_normal(signal.shape)) + offset_v
    return quantise(volts, converter_bits, converter_range_v)


def quantise(volts: NDArray[np.float64], bits: int, range_v: float) -> NDArray[np.float64]:
    """Nearest code of a two's-complement converter, clipped to its range, in V."""
    step = 2 * range_v / 2**bits
    codes = np.clip(np.round(volts / step), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return np.asarray(codes * step)


def clip_peak(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """A channel whose input range was set too low for this hit."""
    limit = CLIPPED_AT * np.max(np.abs(signal))
    return np.clip(signal, -limit, limit)
