"""Peaks that every hit shows as one mode: the fit starts there, and adds no second pole beside them.

Where a mode moves from hit to hit, or while it decays, the poles of high model orders follow the movement with
several poles around it. Peaks that were fitted hit by hit, and whose shape is the same wherever the structure
was struck, tell that there is but one mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, normalised, solve_linear

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

WINDOW = 8.0
"""Decay rates on either side of a peak from which its participations are taken."""

FEWEST_LINES = 10

ABSENT = 0.5
"""Decay rates of a mode within which a peak may be its own."""

STRAYED = 0.5
"""A pole is no longer that of its peak when it lies farther off than so many decay rates, or than hits scatter."""

STRAYED_DECAY = 0.3
"""The same for the logarithm of its decay rate."""


@dataclass(frozen=True)
class KnownPeaks:
    """Peaks of which one mode is known to be there.

    Attributes
    ----------
    poles : complex ndarray, (n_peaks,)
        rad/s, as the FRFs show them.
    reach : ndarray, (n_peaks,)
        Distance within which a pole belongs to the peak, rad/s.
    std : ndarray, (n_peaks, 2)
        Standard deviations of decay and frequency over the hits, rad/s.
    """

    poles: Complex
    reach: Real
    std: Real

    def owners(self, estimate: Estimate) -> NDArray[np.bool_]:
        """The one mode of each peak, (n_modes,)."""
        out = np.zeros(len(estimate.poles), dtype=bool)
        for pole, near in zip(self.poles, self.near(estimate), strict=True):
            if near.any():
                # of two poles at one peak, the one that its damping speaks for
                distance = np.where(near, np.abs(np.log(estimate.poles.real / pole.real)), np.inf)
                distance += np.abs(estimate.poles.imag - pole.imag) / -pole.real
                out[int(np.argmin(distance))] = True
        return out

    def echoes(self, estimate: Estimate) -> NDArray[np.bool_]:
        """Modes at a peak that another mode owns, (n_modes,)."""
        at_a_peak = np.zeros(len(estimate.poles), dtype=bool)
        for near in self.near(estimate):
            at_a_peak |= near
        return at_a_peak & ~self.owners(estimate)

    def strayed(self, before: Estimate, after: Estimate) -> tuple[NDArray[np.bool_], Complex]:
        """Modes that a fit has driven away from their peaks, and where they were, (n_modes,)."""
        out, poles = np.zeros(len(before.poles), dtype=bool), before.poles.copy()
        owners = self.owners(before)
        for pole, std, near in zip(self.poles, self.std, self.near(before), strict=True):
            for r in np.flatnonzero(owners & near):
                far = abs(after.poles[r].imag - pole.imag) > max(-STRAYED * pole.real, 3 * std[1])
                change = abs(np.log(max(after.poles[r].real / pole.real, 1e-9)))
                lost = far or change > STRAYED_DECAY
                out[r], poles[r] = lost, pole if lost else poles[r]
        return out, poles

    def hold(self, pole: complex) -> bool:
        """True where a pole belongs to one of the peaks by its frequency."""
        return bool(np.any(np.abs(self.poles.imag - pole.imag) < self.reach))

    def absent(self, estimate: Estimate) -> KnownPeaks:
        """Peaks near which no mode lies."""
        distance = np.abs(self.poles[:, None] - estimate.poles[None])
        reach = np.maximum(self.reach[:, None], -ABSENT * estimate.poles.real[None])
        return self.take(np.asarray((distance > reach).all(axis=1)))

    def between(self, low: float, high: float) -> KnownPeaks:
        """Peaks between two frequencies, rad/s."""
        return self.take(np.asarray((self.poles.imag >= low) & (self.poles.imag < high)))

    def joined(self, other: KnownPeaks) -> KnownPeaks:
        """Peaks of both."""
        return KnownPeaks(
            np.concatenate([self.poles, other.poles]),
            np.concatenate([self.reach, other.reach]),
            np.concatenate([self.std, other.std]),
        )

    def take(self, keep: NDArray[np.bool_]) -> KnownPeaks:
        """Some of the peaks."""
        return KnownPeaks(self.poles[keep], self.reach[keep], self.std[keep])

    def near(self, estimate: Estimate) -> list[NDArray[np.bool_]]:
        """Modes within the reach of each peak."""
        return [
            np.asarray((np.abs(estimate.poles.imag - p.imag) < r) & (estimate.poles.real < 0))
            for p, r in zip(self.poles, self.reach, strict=True)
        ]


NO_PEAKS = KnownPeaks(np.zeros(0, complex), np.zeros(0), np.zeros((0, 2)))


def seeded(sure: Estimate, weak: Estimate, peaks: KnownPeaks, data: FitData) -> tuple[Estimate, Estimate]:
    """Candidates with one pole at every known peak.

    Where the charts show just one sure pole at a peak, it stays; otherwise the pole that single hits show takes the
    place of all of them.
    """
    for k, pole in enumerate(peaks.poles):
        if not data.omega[0] < pole.imag < data.omega[-1]:
            continue
        one = peaks.take(np.arange(len(peaks.poles)) == k)
        near, also = one.near(sure)[0], one.near(weak)[0]
        if np.count_nonzero(near) != 1:
            sure = sure.take(~near).joined(at_peak(data, pole))
        weak = weak.take(~also)
    return sure, weak


def at_peak(data: FitData, pole: complex) -> Estimate:
    """A mode with the pole of a peak, and the participations that the lines around it show."""
    step = float(data.omega[1] - data.omega[0])
    half = max(int(-WINDOW * pole.real / step), FEWEST_LINES)
    centre = int(np.argmin(np.abs(data.omega - pole.imag)))
    near = data.lines(max(0, centre - half), min(len(data.omega), centre + half + 1))
    poles = np.array([pole])
    residues = np.empty(data.measured.shape, dtype=np.complex128)
    for i in range(data.measured.shape[1]):
        column = near.reference(i)
        weight = np.where(column.measured[..., None], np.ones(column.frf.shape), 0.0)
        residues[:, i] = solve_linear(column, weight, Estimate(poles, np.ones((1, 1), complex))).shapes[:, 0]
    # rows of strong hits must not outweigh all others: each counts by its own size
    size = np.sqrt(np.mean(np.abs(near.frf) ** 2, axis=(1, 2)))
    scaled = residues / np.where(size > 0, size, 1.0)[:, None]
    _, _, vh = np.linalg.svd(np.nan_to_num(scaled), full_matrices=False)
    return Estimate(poles, normalised(vh[:1]))
