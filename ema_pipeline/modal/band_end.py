"""The end of the band: where a peak stands near it, the fit sees lines beyond it, up to a quiet place.

Of a mode at the end of the band the lines show a flank at most. No residual term follows that, and modes within a few
half-widths of it take up what is left: two modes at 1999 and 2023 Hz, the band ending at 2000 Hz, had moved one at
1926 Hz by a ninth of its half-width and were in its shape with 2 to 4 %.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.bands import find_peaks, indicator
from ema_pipeline.modal.data import HIGHEST_SHARE_OF_NYQUIST, arrange

if TYPE_CHECKING:
    from ema_pipeline.frf.types import FrfSet

NEAR = 0.05
"""Share of the end's frequency within which a peak on either side is near."""

BEYOND = 0.10
"""The fit sees this share more at most."""

CLEAR_DB = 10.0
"""A peak stands so far above the noise."""


def seen_band(frfs: FrfSet, band_hz: tuple[float, float], level: NDArray[np.float64]) -> tuple[float, float]:
    """Band whose lines the fit sees, Hz: the analysed one, or one that ends at a quiet line beyond it.

    A continuous excitation has no energy outside its band, so that there is nothing to see.

    Parameters
    ----------
    frfs : FrfSet
    band_hz : tuple of float
        The analysed band.
    level : ndarray, (n_rows, n_references)
        Noise variance of every FRF as `modal.data.arrange` orders them.
    """
    low, high = band_hz
    last = min((1 + BEYOND) * high, HIGHEST_SHARE_OF_NYQUIST * float(frfs.frequency_hz[-1]))
    first, end, stop = np.searchsorted(frfs.frequency_hz, [(1 - NEAR) * high, high, last])
    if frfs.excitation or stop - end < 3:
        return band_hz
    known = np.isfinite(frfs.frf[..., end])
    if not np.isfinite(frfs.frf[..., end:stop][known]).all():
        return band_hz
    curve = indicator(arrange(frfs, (frfs.frequency_hz[first], last)), level)
    peaks = find_peaks(curve)
    near = frfs.frequency_hz[first + peaks] < (1 + NEAR) * high
    if not np.any(near & (curve[peaks] > CLEAR_DB)):
        return band_hz
    return low, float(frfs.frequency_hz[end + int(np.argmin(curve[end - first :]))])
