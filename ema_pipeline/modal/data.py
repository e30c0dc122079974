"""FRFs arranged for the fit: long side in rows, references in columns, lines of the band only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channels import moved_sensors
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.basis import residual_columns
from ema_pipeline.modal.settings import ModalSettings

PERIODS_AT_LOW_END = 3
"""Below three periods per record neither frequency nor damping can be told."""

HIGHEST_SHARE_OF_NYQUIST = 0.95

AT_ONCE = 1 << 18
"""Numbers of a block, so that what is made of it on the way fits into a few megabytes."""

FEW_AT_ONCE = 1 << 17
"""The same where every row is worked on by itself, with several arrays of the block at a time in every thread."""


@dataclass(frozen=True)
class FitData:
    """Accelerance with the shorter side as references.

    Attributes
    ----------
    omega : ndarray, (n_lines,)
        rad/s, equally spaced.
    frf : complex ndarray, (n_rows, n_references, n_lines)
        Accelerance, (m/s²)/N; 0 where not measured. A roving hammer is transposed by reciprocity. A view of the
        FRFs where they are accelerances already: not to be written to.
    variance : ndarray, (n_rows, n_references, n_lines)
        From the scatter over hits; NaN or 0 where unknown.
    measured : ndarray of bool, (n_rows, n_references)
    rest_s : float
        Mean time from hit to end of the record.
    transposed : bool
        True where rows are inputs and references are outputs.
    window_rad_s : float
        Decay rate of the exponential window under which all was measured, noise too; 0 for none.
    in_turn : bool
        True where a sensor was moved from DOF to DOF: the hits of every turn have a mean direction of their own.
    cut_s : float, optional
        Mean time before the hit in records that end while the responses ring; None where they have decayed.
    """

    omega: NDArray[np.float64]
    frf: NDArray[np.complex128]
    variance: NDArray[np.float64]
    measured: NDArray[np.bool_]
    rest_s: float
    transposed: bool
    window_rad_s: float = 0.0
    in_turn: bool = False
    cut_s: float | None = None

    def lines(self, first: int, stop: int) -> FitData:
        """The same FRFs on lines ``first:stop``."""
        cut = slice(first, stop)
        return replace(self, omega=self.omega[cut], frf=self.frf[..., cut], variance=self.variance[..., cut])

    def rows(self, rows: slice) -> FitData:
        """Some rows on the same lines."""
        return replace(self, frf=self.frf[rows], variance=self.variance[rows], measured=self.measured[rows])

    def reference(self, number: int) -> FitData:
        """One column of FRFs on the same lines."""
        one = [number]
        return replace(
            self, frf=self.frf[:, one], variance=self.variance[:, one], measured=self.measured[:, one]
        )

    def residual_columns(self) -> NDArray[np.complex128]:
        """See `basis.residual_columns`."""
        return residual_columns(self.omega, self.cut_s)

    def row_blocks(self, numbers: int = AT_ONCE) -> list[slice]:
        """Rows in blocks that are small beside the whole, for what can be done row by row."""
        at_once = max(1, numbers // max(1, self.frf[0].size))
        return [slice(k, min(k + at_once, len(self.frf))) for k in range(0, len(self.frf), at_once)]

    def line_blocks(self) -> list[slice]:
        """The same over lines."""
        at_once = max(64, AT_ONCE // max(1, self.measured.size))
        return [slice(k, min(k + at_once, len(self.omega))) for k in range(0, len(self.omega), at_once)]


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
            "widen band_hz of test.toml, or low_hz and high_hz of modal.identify, record for longer, or use a "
            "harder hammer tip"
        )
    return low, high


def arrange(frfs: FrfSet, band_hz: tuple[float, float]) -> FitData:
    """Accelerance on the lines of the band, the shorter side as references.

    Raises
    ------
    EmaError
        Where nothing was measured, or an FRF is not finite on some lines only.
    """
    low = int(np.searchsorted(frfs.frequency_hz, band_hz[0]))
    inside = slice(low, int(np.searchsorted(frfs.frequency_hz, band_hz[1], side="right")))
    omega = 2 * np.pi * frfs.frequency_hz[inside]
    acc, variance = frfs.frf[..., inside], frfs.variance[..., inside]
    if set(frfs.quantities) != {"acceleration"}:
        derivatives = np.array(
            [{"acceleration": 0, "velocity": 1, "displacement": 2}[q] for q in frfs.quantities]
        )
        factors = (1j * omega) ** derivatives[:, None, None]
        acc, variance = acc * factors, variance * np.abs(factors) ** 2
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
    if not measured.all():
        acc = np.where(measured[..., None], acc, 0.0)
    transposed = acc.shape[0] < acc.shape[1]
    if transposed:
        acc, variance, measured = acc.swapaxes(0, 1), variance.swapaxes(0, 1), measured.T
    in_turn = bool(moved_sensors(frfs))
    return FitData(
        omega, acc, variance, measured, frfs.rest_s, transposed, frfs.response_decay_rad_s, in_turn,
        float(np.nanmean(frfs.delay_s)) if frfs.rings_on else None,
    )  # fmt: skip
