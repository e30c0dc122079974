"""Measured modes of which only the frequencies are known, as a paper prints them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes


def from_frequencies(
    configuration: str,
    frequency_hz: Sequence[float] | NDArray[np.float64],
    frequency_std_hz: Sequence[float] | None = None,
) -> MeasuredModes:
    """Modes of a configuration from frequencies in ascending order."""
    frequency = np.asarray(frequency_hz, dtype=float)
    unknown = np.full(frequency.shape, np.nan)
    std = unknown if frequency_std_hz is None else np.asarray(frequency_std_hz, float)
    return MeasuredModes(configuration, frequency, std, unknown, unknown.copy())
