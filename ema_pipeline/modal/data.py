"""FRFs arranged for the fit: long side in rows, references in columns, lines of the band only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.settings import ModalSettings

PERIODS_AT_LOW_END = 3
"""Below three periods per record neither frequency nor damping can be told."""

HIGHEST_SHARE_OF_NYQUIST = 0.95


@dataclass(frozen=True)
class FitData:
    """Accelerance with the shorter side as references.

    Attributes
    ----------
    omega : ndarray, (n_lines,)
        rad/s, equally spaced.
    frf : complex ndarray, (n_rows, n_references, n_lines)
        Accelerance, (m/s²)/N; 0 where not measured. A roving hammer is transposed by reciprocity.
    variance : ndarray, (n_rows, n_references, n_lines)
        From the scatter over hits; NaN where unknown.
    measured : ndarray of bool, (n_rows, n_references)
    rest_s : float
        Mean time from hit to end of the record.
    transposed : bool
        True where rows are inputs and references are outputs.
    """

    omega: NDArray[np.float64]
    frf: NDArray[np.complex128]
    variance: NDArray[np.float64]
    measured: NDArray[np.bool_]
    rest_s: float
    transposed: bool

    def lines(self, first: int, stop: int) -> FitData:
        """The same FRFs on lines ``first:stop``."""
        cut = slice(first, stop)
        return FitData(
            self.omega[cut],
            self.frf[..., cut],
            self.variance[..., cut],
            self.measured,
            self.rest_s,
            self.transposed,
        )


def analysis_band(frfs: FrfSet, settings: ModalSettings) -> tuple[float, float]:
    """Band to analyse, Hz.

    Raises
    ------
    EmaError
        Where the band holds fewer than 16 lines.
    """
    df = float(frfs.frequency_hz[1] - frfs.frequency_hz[0])
    nyquist = float(frfs.frequency_hz[-1])
    lowest = PERIODS_AT_LOW_END / frfs.record_s
    low = max(frfs.band_hz[0], lowest) if settings.low_hz is None else max(settings.low_hz, df)
    high = (
        min(frfs.band_hz[1], HIGHEST_SHARE_OF_NYQUIST * nyquist)
        if settings.high_hz is None
        else min(settings.high_hz, nyquist)
    )
    if (high - low) / df < 16:
        raise EmaError(
            f"the band to analyse, {low:.4g} to {high:.4g} Hz, holds fewer than 16 lines of {df:.4g} Hz: "
            "widen low_hz and high_hz, record for longer, or use a harder hammer tip"
        )
    return low, high


def arrange(frfs: FrfSet, band_hz: tuple[float, float]) -> FitData:
    """Accelerance on the lines of the band, the shorter side as references.

    Raises
    ------
    EmaError
        Where nothing was measured, or an FRF is not finite on some lines only.
    """
    inside = (frfs.frequency_hz >= band_hz[0]) & (frfs.frequency_hz <= band_hz[1])
    omega = 2 * np.pi * frfs.frequency_hz[inside]
    acc = frfs.accelerance()[..., inside]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(acc) / np.abs(frfs.frf[..., inside])
    variance = frfs.variance[..., inside] * np.where(np.isfinite(ratio), ratio, 0.0) ** 2
    finite = np.isfinite(acc)
    measured = np.asarray(finite.all(axis=-1))
    if not measured.any():
        raise EmaError("no FRF was measured: nothing to identify modes from")
    partly = finite.any(axis=-1) & ~measured
    if partly.any():
        o, i = np.argwhere(partly)[0]
        raise EmaError(
            f"FRF {frfs.outputs[o]} over {frfs.inputs[i]} is not a number at some lines: estimate it again"
        )
    acc = np.where(measured[..., None], acc, 0.0)
    variance = np.where(np.isfinite(variance) & (variance > 0), variance, np.nan)
    rest_s = max(frfs.record_s - float(np.nanmean(frfs.delay_s)), 0.5 * frfs.record_s)
    transposed = acc.shape[0] < acc.shape[1]
    if transposed:
        acc, variance, measured = acc.swapaxes(0, 1), variance.swapaxes(0, 1), measured.T
    return FitData(omega, np.ascontiguousarray(acc), variance, measured, rest_s, transposed)
