"""Sub-bands: a wide band is split where the response is quiet, so that no model holds too many modes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.maxima import prominent_peaks

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

MAX_PEAKS = 7
"""Peaks per sub-band."""

MAX_RATIO = 4.0
"""Upper over lower end of a sub-band: one uniform time step cannot serve much more."""

MIN_LINES = 48
"""A sub-band has at least this many lines."""

OVERLAP = 0.2
"""Margin on either side, as a share of the sub-band's width; modes are reported from the core only."""


@dataclass(frozen=True)
class SubBand:
    """Lines ``first:stop`` are analysed; modes between `low` and `high` (rad/s) are reported.

    Attributes
    ----------
    first, stop : int
    low, high : float
    n_peaks : int
        Peaks seen among the lines.
    """

    first: int
    stop: int
    low: float
    high: float
    n_peaks: int


def indicator(data: FitData, level: Real) -> Real:
    """Response of all FRFs over their noise, as one curve over frequency (dB).

    Parameters
    ----------
    data : FitData
    level : ndarray, (n_rows, n_references)
        Noise variance of each FRF.
    """
    power = np.zeros(len(data.omega))
    for row, share in zip(data.frf, np.where(data.measured, 1.0 / level, 0.0), strict=True):
        power += share @ np.abs(row) ** 2
    return np.asarray(10 * np.log10(np.maximum(power / max(data.measured.sum(), 1), 1e-30)))


def find_peaks(curve: Real) -> NDArray[np.int64]:
    """Peaks that stand out of a curve in dB by 3 dB."""
    smooth = scipy.ndimage.gaussian_filter1d(curve, 1.0)
    return prominent_peaks(smooth, 3.0)[0]


def split(omega: Real, curve: Real) -> tuple[SubBand, ...]:
    """Split the band at quiet places until each part is narrow and simple enough.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
    curve : ndarray, (n_lines,)
        From `indicator`.
    """
    peaks = find_peaks(curve)
    smooth = scipy.ndimage.gaussian_filter1d(curve, 2.0)
    cuts = sorted({0, len(omega), *_cuts(omega, smooth, peaks, 0, len(omega))})
    parts = []
    for a, b in itertools.pairwise(cuts):
        margin = max(int(OVERLAP * (b - a)), 16)
        first, stop = max(0, a - margin), min(len(omega), b + margin)
        parts.append(
            SubBand(
                first,
                stop,
                float(omega[a]) if a else 0.0,
                float(omega[b]) if b < len(omega) else float(np.inf),
                int(np.count_nonzero((peaks >= first) & (peaks < stop))),
            )
        )
    return tuple(parts)


def _cuts(omega: Real, smooth: Real, peaks: NDArray[np.int64], a: int, b: int) -> list[int]:
    """Cuts inside ``a:b``, the quietest line of the middle part first."""
    count = int(np.count_nonzero((peaks >= a) & (peaks < b)))
    if b - a < 2 * MIN_LINES or (count <= MAX_PEAKS and omega[b - 1] <= MAX_RATIO * omega[a]):
        return []
    if omega[b - 1] > MAX_RATIO * omega[a]:
        middle = float(np.sqrt(omega[a] * omega[b - 1]))
        middle = max(middle, omega[min(a + MIN_LINES, b - 1)])
        low, high = middle / 1.5, middle * 1.5
    else:
        width = omega[b - 1] - omega[a]
        low, high = omega[a] + 0.25 * width, omega[b - 1] - 0.25 * width
    first = max(int(np.searchsorted(omega, low)), a + MIN_LINES)
    stop = min(int(np.searchsorted(omega, high)), b - MIN_LINES)
    if stop <= first:
        first = stop = int(np.clip((a + b) // 2, a + MIN_LINES, b - MIN_LINES))
    cut = first + int(np.argmin(smooth[first : stop + 1]))
    return [*_cuts(omega, smooth, peaks, a, cut), cut, *_cuts(omega, smooth, peaks, cut, b)]


def between(poles: Complex, low: float, high: float) -> NDArray[np.bool_]:
    """True for poles between two frequencies, rad/s."""
    return np.asarray((poles.imag >= low) & (poles.imag < high))
