"""One record of continuous excitation, prepared for comparison: its force between samples, its lines, their noise."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft
from scipy.ndimage import uniform_filter1d

from ema_pipeline.ingest.driven import DrivenRecord
from ema_pipeline.mechanics.simulation import between_samples

BANDS = 8
"""Bands of frequency, each with a noise of its own: what a model leaves is seldom white."""
DISCREPANCY = 1e-2
"""Standard uncertainty of a response as a share of its root mean square: sensors, and a force known at samples only."""
SHARE = "share of the response"
"""Name of the scatter in proportion to the response itself."""
_RESTLESS = 1.5
"""A first period that differs from the mean by this many times what others do holds a transient."""
_AROUND = 5
"""Lines over which the level of a response is taken: as many as a half-power width, few beside a band."""
_LEAST_WINDOW = 64
"""Shortest window, samples: fewer do not fill the bands of frequency."""


@dataclass(frozen=True)
class RecordData:
    """What is compared of one record.

    Attributes
    ----------
    record : DrivenRecord
        Of a periodic one the mean period.
    noise : ndarray, (n_outputs, BANDS)
        1 σ of a sample of the response within each band, from its scatter over periods; 0 where there is none.
    starts : ndarray of int, (n_windows,)
        First samples of the windows that are compared: one, of the whole record, unless said otherwise.
    length : int
        Samples of a window; 0 for the whole record.
    """

    record: DrivenRecord
    noise: NDArray[np.float64]
    starts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    length: int = 0

    @classmethod
    def of(cls, record: DrivenRecord) -> RecordData:
        """A record, its periods averaged where it has some."""
        none = np.zeros((len(record.channels), BANDS))
        if not record.period:
            return cls(record, none)
        force = record.force.reshape(len(record.force), -1, record.period)
        responses = record.responses.reshape(len(record.responses), -1, record.period)
        steady = _steady(responses, -(-record.transient // record.period))
        force, responses = force[:, steady:], responses[:, steady:]
        mean = replace(record, force=force.mean(axis=1), responses=responses.mean(axis=1), transient=0)
        count = responses.shape[1]
        if count < 2:
            return cls(mean, none)
        lines = _lines(responses - responses.mean(axis=1, keepdims=True))
        band = _bands(record.period)
        power = np.sum(lines**2, axis=1) / (count - 1) / count
        return cls(mean, np.sqrt([[float(np.mean(p[band == b])) for b in range(BANDS)] for p in power]))

    def windows(self, length: int, samples: int) -> RecordData:
        """The record in windows, evenly spread, no more than so many samples; each starts from a state of its own.

        The ends of a record that does not repeat are left out: no state is known from what is integrated there.
        """
        first, last = self.compared.start or 0, self.record.n_samples
        length = min(max(length, _LEAST_WINDOW), (last - first) // 2)
        if not self.periodic:
            first, last = first + length // 2, last - length // 2
        count = (last - first) // length
        chosen = np.unique(np.linspace(0, count - 1, min(max(samples // length, 1), count)).astype(np.int64))
        return replace(self, starts=first + chosen * length, length=length)

    @property
    def windowed(self) -> bool:
        """True for a record in windows."""
        return self.length > 0

    @property
    def periodic(self) -> bool:
        """True for a steady response, whose state at the start follows from the force."""
        return self.record.period > 0 and not self.windowed

    @property
    def samples(self) -> int:
        """Of every window."""
        return self.length or self.record.n_samples

    @cached_property
    def rms(self) -> NDArray[np.float64]:
        """Root mean square of every response about its mean, (n_outputs,)."""
        return np.asarray(np.std(self.record.responses, axis=1))

    @property
    def compared(self) -> slice:
        """Samples of every window that are compared."""
        return slice(0 if self.windowed or self.periodic else self.record.transient, None)

    @cached_property
    def responses(self) -> NDArray[np.float64]:
        """What the sensors read in every window, (n_windows, n_outputs, n_samples), SI."""
        at = self.starts[:, None] + np.arange(self.samples)
        return np.ascontiguousarray(self.record.responses[:, at].transpose(1, 0, 2))

    @cached_property
    def measured(self) -> NDArray[np.float64]:
        """Lines of the responses, (n_windows, n_outputs, n_rows), SI."""
        return self.lines(self.responses[..., self.compared])

    @cached_property
    def level(self) -> NDArray[np.float64]:
        """Root mean square of `measured` over windows and the lines around each, (n_outputs, n_rows).

        A force that is measured wrong by a share of itself moves the response by that share of its own, line by line.
        """
        power = np.mean(self.measured**2, axis=0)
        count = (power.shape[-1] - 1) // 2
        power = 0.5 * (power[:, 1 : count + 1] + power[:, count + 1 :])
        around = uniform_filter1d(power, _AROUND, axis=-1, mode="nearest")
        waves = np.sqrt(
            np.maximum(around, 0.0)
        )  # its running sum leaves less than nought where lines are nought
        return np.concatenate([waves[:, :1], waves, waves], axis=-1)

    def lines(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lines of signals, (n_windows, n_outputs, ..., n_samples) to (n_windows, n_outputs, ..., n_rows).

        Means of displacements are included. What other sensors give as a mean is their offset.
        """
        found = _lines(samples)
        for o, channel in enumerate(self.record.channels):
            if channel.quantity != "displacement":
                found[:, o, ..., 0] = 0.0
        return found

    @cached_property
    def band(self) -> NDArray[np.int64]:
        """Band of every row of `measured`, (n_rows,)."""
        return _bands(self.samples - (self.compared.start or 0))

    def fine_force(self, substeps: int) -> NDArray[np.float64]:
        """Force at the ends and middles of the steps, and a column of ones, (n_windows, n_points, n_forces + 1)."""
        known: dict[int, NDArray[np.float64]] = self.__dict__.setdefault("_fine", {})
        if substeps not in known:
            fine = between_samples(self.record.force, 2 * substeps, self.record.period > 0)
            fine = np.concatenate([fine, np.ones((len(fine), 1))], axis=1)
            if self.windowed:
                points = 2 * substeps * (self.length - 1) + 1
                fine = fine[2 * substeps * self.starts[:, None] + np.arange(points)]
            known[substeps] = np.ascontiguousarray(fine.reshape(len(self.starts), -1, fine.shape[-1]))
        return known[substeps]

    def motion(self, slowest_hz: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Displacements and velocities that the sensors suggest, (n_outputs, n_samples) each, in the whole record.

        Parameters
        ----------
        slowest_hz : float
            Frequency below which a structure does not move: what is integrated below it is noise.
        """
        known: dict[float, tuple[NDArray[np.float64], NDArray[np.float64]]] = self.__dict__.setdefault(
            "_motion", {}
        )
        if slowest_hz not in known:
            pairs = [
                _integrated(
                    signal, self.record.sample_rate_hz, slowest_hz, _POWER[c.quantity], self.record.period > 0
                )
                for signal, c in zip(self.record.responses, self.record.channels, strict=True)
            ]
            known[slowest_hz] = np.array([x for x, _ in pairs]), np.array([v for _, v in pairs])
        return known[slowest_hz]


_POWER = {"displacement": 0, "velocity": 1, "acceleration": 2}


def _integrated(
    signal: NDArray[np.float64], rate: float, slowest_hz: float, power: int, periodic: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacement and velocity of a signal that is the derivative of a displacement of order `power`."""
    count = len(signal)
    pad = 0 if periodic else count - 1
    whole = np.pad(signal, pad, mode="reflect", reflect_type="odd") if pad else signal
    omega = 2j * np.pi * rate * np.fft.rfftfreq(len(whole))
    spectrum = np.asarray(rfft(whole))
    seen = np.abs(omega) > 2 * np.pi * slowest_hz
    factor = np.where(seen, omega, 1.0) ** -power
    x = np.where(seen | (power == 0), spectrum * factor, 0.0)
    return tuple(np.asarray(irfft(s, len(whole)))[pad : pad + count] for s in (x, x * omega))  # type: ignore[return-value]


def _lines(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean, real and imaginary parts of the lines of signals, (..., n_rows): white noise stays white."""
    count = samples.shape[-1]
    spectrum = np.asarray(rfft(samples, axis=-1))
    waves = spectrum[..., 1 : (count + 1) // 2] * np.sqrt(2 / count)
    return np.concatenate([spectrum[..., :1].real / np.sqrt(count), waves.real, waves.imag], axis=-1)


def _bands(count: int) -> NDArray[np.int64]:
    lines = (count + 1) // 2 - 1
    band = np.minimum(BANDS * np.arange(lines) // max(lines, 1), BANDS - 1)
    return np.asarray(np.concatenate([[0], band, band]), dtype=np.int64)


def _steady(responses: NDArray[np.float64], least: int) -> int:
    """Number of periods at the start that hold a transient."""
    count = responses.shape[1]
    if least or count < 4:
        return min(least, count - 1)
    mean = responses[:, 1:].mean(axis=1, keepdims=True)
    away = np.sqrt(np.mean((responses - mean) ** 2, axis=(0, 2)))
    return 1 if away[0] > _RESTLESS * float(np.max(away[1:])) else 0
