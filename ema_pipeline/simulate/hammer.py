"""Hammer blows as pulses whose spectrum is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Pulse:
    """A blow: peak·cos²(π(t - time)/contact) while the hammer touches.

    Attributes
    ----------
    time_s : float
        Time of the peak.
    peak_n : float
    contact_s : float
        Duration of contact.
    """

    time_s: float
    peak_n: float
    contact_s: float

    def force(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Force, N, at any times."""
        phase = (time_s - self.time_s) / self.contact_s
        return np.where(np.abs(phase) < 0.5, self.peak_n * np.cos(np.pi * phase) ** 2, 0.0)

    def spectrum(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Fourier transform ∫F e^{-jωt}dt, N·s."""
        x = frequency_hz * self.contact_s
        near = np.isclose(np.abs(x), 1.0, atol=1e-6)
        shape = np.where(near, 0.5, np.sinc(x) / np.where(near, 1.0, 1.0 - x**2))
        turn = np.exp(-2j * np.pi * frequency_hz * self.time_s)
        return np.asarray(0.5 * self.peak_n * self.contact_s * shape * turn)


@dataclass(frozen=True)
class ForceHistory:
    """All blows of one record, and how it is sampled."""

    pulses: tuple[Pulse, ...]
    sample_rate_hz: float
    n_samples: int

    def spectrum(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Fourier transform of all blows, N·s."""
        return np.asarray(sum(p.spectrum(frequency_hz) for p in self.pulses))
