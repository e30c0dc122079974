"""Plain peaks of a set of FRFs, which a list of modes is held against."""

from __future__ import annotations

import numpy as np

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.drift.local import plain_pole
from ema_pipeline.modal.drift.windows import peak_frfs
from ema_pipeline.modal.peaks import KnownPeaks

REACH = 2.0
"""Decay rates of a peak within which a mode may be the one that makes it."""

STD = 0.3
"""Standard deviation of decay and frequency of a pole from its peak alone, in its decay rate: what lies under the peak
is taken for a straight line."""


def plain_peaks(frfs: FrfSet, band_hz: tuple[float, float]) -> KnownPeaks:
    """Peaks that one pole explains.

    Parameters
    ----------
    frfs : FrfSet
    band_hz : tuple of float
    """
    found = []
    for window, frf, omega in peak_frfs(frfs, band_hz, most=None):
        pole = plain_pole(window, frf, omega, frfs.rest_s)
        if pole is not None:
            found.append(pole)
    poles = np.array(found, dtype=np.complex128)
    std = np.repeat(-STD * poles.real[:, None], 2, axis=1)
    return KnownPeaks(poles, -REACH * poles.real, std)
