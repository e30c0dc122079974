"""Residues of the plain peaks of a set of FRFs, each peak alone, which sensors are held against each other by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.drift.local import peak_residues
from ema_pipeline.modal.drift.windows import peak_windows

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


@dataclass(frozen=True)
class PlainResidues:
    """Residues of one peak.

    Attributes
    ----------
    omega : float
        Its frequency, rad/s.
    residues : complex ndarray, (n_inputs, n_outputs)
        0 where not known.
    variance : ndarray, (n_inputs, n_outputs)
        E|r - E r|²; infinite where not known.
    """

    omega: float
    residues: Complex
    variance: Real


def plain_residues(frfs: FrfSet, band_hz: tuple[float, float]) -> list[PlainResidues]:
    """Residues of every plain peak in a band, at the pole that all FRFs share."""
    rest_s = max(frfs.record_s - float(np.nanmean(frfs.delay_s)), 0.5 * frfs.record_s)
    n_outputs, n_inputs = frfs.hits.shape
    found = []
    for window in peak_windows(frfs, band_hz):
        frf = frfs.accelerance(window.lines)[window.outputs].swapaxes(0, 1)
        peak = peak_residues(window, frf, 2 * np.pi * frfs.frequency_hz[window.lines], rest_s)
        if peak is None:
            continue
        residues = np.zeros((n_inputs, n_outputs), dtype=np.complex128)
        variance = np.full((n_inputs, n_outputs), np.inf)
        known = np.isfinite(peak.variance) & (peak.variance > 0)
        residues[:, window.outputs] = np.where(known, peak.residues, 0.0)
        variance[:, window.outputs] = np.where(known, peak.variance, np.inf)
        if residues.any():
            found.append(PlainResidues(window.pole.imag, residues, variance))
    return found
