"""Residues of the plain peaks of a set of FRFs, each peak alone, which sensors are held against each other by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.drift.local import peak_residues
from ema_pipeline.modal.drift.windows import peak_frfs
from ema_pipeline.modal.low_rank import first_right, low_rank

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

FEWEST_PEAKS = 3
"""Peaks that must show a fault of a sensor alike: of each one it may be a second mode close by."""

FALSE_ALARM = 1e-6
"""Probability that chance makes a fault anywhere in a set of FRFs."""


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

    @property
    def free(self) -> int:
        """Residues beyond those that a matrix of rank one can follow; negative where it follows more."""
        return int(np.count_nonzero(np.isfinite(self.variance))) - sum(self.variance.shape) + 1

    def rank_one(self, steps: int) -> tuple[Complex, Complex, float]:
        """The matrix of rank one that fits best: left and right factor, and what it leaves, squared over the variances.

        Parameters
        ----------
        steps : int
            Of alternating least squares.
        """
        weight = 1 / self.variance
        left, right = low_rank(self.residues, weight, first_right(self.residues, 1), steps)
        return left, right, float(np.sum(weight * np.abs(self.residues - left @ right) ** 2))


def plain_residues(frfs: FrfSet, band_hz: tuple[float, float]) -> list[PlainResidues]:
    """Residues of every plain peak in a band, at the pole that all FRFs share."""
    n_outputs, n_inputs = frfs.hits.shape
    found = []
    for window, frf, omega in peak_frfs(frfs, band_hz):
        peak = peak_residues(window, frf, omega, frfs.rest_s)
        if peak is None or not peak.residues.any():
            continue
        residues = np.zeros((n_inputs, n_outputs), dtype=np.complex128)
        variance = np.full((n_inputs, n_outputs), np.inf)
        residues[:, window.outputs], variance[:, window.outputs] = peak.residues, peak.variance
        found.append(PlainResidues(window.pole.imag, residues, variance))
    return found
