"""The measured hits as the time-domain fit sees them: a window after each blow, weighted line by line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ema_pipeline.dof import Dof
from ema_pipeline.ingest.records import Hit, Record
from ema_pipeline.mechanics.batch_lines import faded_lines

_BEFORE_S = 0.004
"""Taken before the peak of the force: the pulse's flank and the filter's ringing."""

_LEAST_S = 0.02
"""A window holds the pulse and what comes of it."""

_QUIET_S = 0.05
"""The stretch before that which tells offset and noise."""

_TIMING = 0.02
"""Samples by which hammer and sensors may be apart in time otherwise than in the other hits: a delay that all hits
share is an error alike at every level."""

_SPILT = 0.2
"""Share of what the simulation misses, on average over the sensors, that shows in a sensor which hardly moves."""

_SMOOTHED = 0.08
"""Share of a frequency over which the measured power is averaged for the weights."""


@dataclass(frozen=True)
class HitWindows:
    """Windows after the blows of one configuration.

    Attributes
    ----------
    configuration : str
    names : tuple of str
        ``file#number`` of each hit.
    level : ndarray of int, (n_hits,)
        Force level of each hit, from 0 for the softest.
    force_n : ndarray, (n_levels,)
    impacts : tuple of Dof
        Of each hit.
    sensors : tuple of Dof
    quantities : tuple of str
        What each sensor measures.
    sample_rate_hz : float
    force : ndarray, (n_hits, n_samples)
    measured : ndarray, (n_hits, n_sensors, n_samples)
    present : ndarray of bool, (n_hits, n_sensors)
        False where a sensor was left out of a hit.
    noise : ndarray, (n_hits, n_sensors)
        Standard deviation of the sensors' noise, from the samples before the blow.
    band_hz : tuple of float
    modes : int
        Measured modes in the band.
    unsure : ndarray, (n_hits,)
        Share of each hit's motion that the model which chose the hits does not foretell, see `diagnose.levels.views`.
    """

    configuration: str
    names: tuple[str, ...]
    level: NDArray[np.int64]
    force_n: NDArray[np.float64]
    impacts: tuple[Dof, ...]
    sensors: tuple[Dof, ...]
    quantities: tuple[str, ...]
    sample_rate_hz: float
    force: NDArray[np.float64]
    measured: NDArray[np.float64]
    present: NDArray[np.bool_]
    noise: NDArray[np.float64]
    band_hz: tuple[float, float]
    modes: int
    unsure: NDArray[np.float64]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(n_samples,), from the start of the window."""
        return np.arange(self.force.shape[1]) / self.sample_rate_hz

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Lines inside the band, (n_lines,)."""
        return np.asarray(self.lines * self.sample_rate_hz / self.force.shape[1])

    @property
    def lines(self) -> NDArray[np.int64]:
        """Numbers of the spectrum's lines inside the band, (n_lines,)."""
        f = scipy.fft.rfftfreq(self.force.shape[1], 1 / self.sample_rate_hz)
        return np.flatnonzero((f >= self.band_hz[0]) & (f <= self.band_hz[1]))

    @property
    def fade_s(self) -> float:
        """Time constant of the exponential weight that lets signals fade out, so that their ends leave no trace."""
        return 0.5 * float(self.time_s[-1])

    def spectra(self, signals: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Spectra inside the band of signals (..., n_samples) that are weighted with exp(-t/fade_s)."""
        return faded_lines(signals, self.fade_s * self.sample_rate_hz, self.lines)

    def in_band(self, signals: NDArray[np.float64]) -> NDArray[np.float64]:
        """The signals' part inside the band, (..., n_samples)."""
        whole = scipy.fft.rfft(signals, axis=-1)
        spectrum = np.zeros_like(whole)
        spectrum[..., self.lines] = whole[..., self.lines]
        return np.asarray(scipy.fft.irfft(spectrum, signals.shape[-1], axis=-1))

    def sigma(self, floor: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Uncertainty of each line, measured amplitude around it, and share of its power that is no noise.

        The standard uncertainty, (n_hits, n_sensors, n_lines), is the sensors' noise, and shares of the measured
        amplitude: `floor`, what is `unsure`, and the angle that `_TIMING` of a sample between hammer and sensors makes.
        A sensor that symmetry keeps still gets `_SPILT` of the first two of the others: a force between bodies that is
        a little off moves it at once. The uncertainty is infinite, and the share 0, where a sensor is absent.
        """
        f = self.frequency_hz
        noise = self.noise[..., None] ** 2 * np.sum(np.exp(-2 * self.time_s / self.fade_s))
        own = np.hypot(floor, self.unsure)[:, None, None]
        share = own**2 + (2 * np.pi * f * _TIMING / self.sample_rate_hz) ** 2
        power = _smoothed(f, np.abs(self.spectra(self.measured)) ** 2)
        total = np.sqrt(noise + share * power + (_SPILT * own) ** 2 * self._alike(power))
        there = self.present[..., None]
        signal = np.clip(1 - 2 * noise / np.maximum(power, 1e-300), 0.0, 1.0)
        return np.where(there, total, np.inf), np.sqrt(power), np.where(there, signal, 0.0)

    def _alike(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean power over all sensors of each sensor's quantity, like `power`."""
        mean = np.zeros_like(power)
        for quantity in set(self.quantities):
            at = [i for i, q in enumerate(self.quantities) if q == quantity]
            count = np.maximum(self.present[:, at].sum(axis=1), 1)[:, None, None]
            mean[:, at] = (power * self.present[..., None])[:, at].sum(axis=1, keepdims=True) / count
        return mean

    def shortened(self, share: float) -> HitWindows:
        """The first part of the windows, `_LEAST_S` of it at least."""
        least = round(_LEAST_S * self.sample_rate_hz)
        n = _quick_length(min(max(int(share * self.force.shape[1]), least), self.force.shape[1]))
        return replace(self, force=self.force[:, :n], measured=self.measured[..., :n])

    def only(self, keep: NDArray[np.bool_]) -> HitWindows:
        """Some of the hits."""
        at = np.flatnonzero(keep)
        return replace(
            self,
            names=tuple(self.names[i] for i in at),
            level=self.level[keep],
            impacts=tuple(self.impacts[i] for i in at),
            force=self.force[keep],
            measured=self.measured[keep],
            present=self.present[keep],
            noise=self.noise[keep],
            unsure=self.unsure[keep],
        )


def _quick_length(samples: int) -> int:
    """The longest window of at most so many samples whose spectra are quickly found."""
    return int(scipy.fft.prev_fast_len(samples, real=True))


def _smoothed(f: NDArray[np.float64], power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Running mean over a share of the frequency: even in the logarithm of the frequency."""
    if f.size < 4:
        return np.broadcast_to(power.mean(axis=-1, keepdims=True), power.shape)
    even = np.geomspace(f[0], f[-1], 4 * f.size)
    width = max(int(_SMOOTHED / np.log(even[1] / even[0])), 1)
    at = np.clip(np.searchsorted(f, even), 1, f.size - 1)
    share = (even - f[at - 1]) / (f[at] - f[at - 1])
    spread = power[..., at - 1] * (1 - share) + power[..., at] * share
    mean = uniform_filter1d(spread, width, axis=-1, mode="nearest")
    back = np.clip(np.searchsorted(even, f), 0, even.size - 1)
    return np.asarray(mean[..., back])


def hit_windows(
    hits: Iterable[tuple[Record, Hit]],
    configuration: str,
    levels: Mapping[str, int],
    force_n: Sequence[float],
    band_hz: tuple[float, float],
    length_s: float,
    modes: int,
) -> HitWindows:
    """Windows after the blows, one hit of every impact point at every level.

    Parameters
    ----------
    hits : iterable of (Record, Hit)
        Accepted hits with their records.
    configuration : str
    levels : mapping of str to int
        Level of each hit by ``file#number``; other hits are left out.
    force_n : sequence of float
        Of each level.
    band_hz : tuple of float
    length_s : float
        Of the window; shorter where the records are.
    modes : int
        Measured modes in the band.
    """
    taken: set[tuple[str, int]] = set()
    chosen: list[_Window] = []
    for record, hit in hits:
        name = f"{hit.file}#{hit.number}"
        key = (str(hit.impact), levels.get(name, -1))
        if name in levels and key not in taken:
            taken.add(key)
            chosen.append(_window(record, hit, levels[name], length_s))
    rate = chosen[0].record.sample_rate_hz
    length = _quick_length(min(w.force.size for w in chosen))
    sensors = tuple(dict.fromkeys((str(c.dof), c.quantity) for w in chosen for c in w.record.channels))
    at = {s: i for i, s in enumerate(sensors)}
    measured = np.zeros((len(chosen), len(sensors), length))
    present = np.zeros(measured.shape[:2], dtype=bool)
    noise = np.zeros(measured.shape[:2])
    for i, w in enumerate(chosen):
        for j, c in enumerate(w.record.channels):
            if c.name in w.hit.rejected_channels:
                continue
            k = at[str(c.dof), c.quantity]
            present[i, k] = True
            measured[i, k] = w.responses[j, :length]
            noise[i, k] = w.noise[j]
    return HitWindows(
        configuration=configuration,
        names=tuple(f"{w.hit.file}#{w.hit.number}" for w in chosen),
        level=np.array([w.level for w in chosen], dtype=np.int64),
        force_n=np.array(force_n, dtype=float),
        impacts=tuple(w.hit.impact for w in chosen),
        sensors=tuple(Dof.parse(s) for s, _ in sensors),
        quantities=tuple(q for _, q in sensors),
        sample_rate_hz=rate,
        force=np.stack([w.force[:length] for w in chosen]),
        measured=measured,
        present=present,
        noise=noise,
        band_hz=band_hz,
        modes=modes,
        unsure=np.zeros(len(chosen)),
    )


@dataclass(frozen=True)
class _Window:
    record: Record
    hit: Hit
    level: int
    force: NDArray[np.float64]
    responses: NDArray[np.float64]
    noise: NDArray[np.float64]


def _window(record: Record, hit: Hit, level: int, length_s: float) -> _Window:
    """Cut from the record itself: a hit may start at its pulse, and what was before it tells offset and noise."""
    rate = record.sample_rate_hz
    start = max(0, hit.peak - round(_BEFORE_S * rate))
    stop = min(hit.stop, start + round(length_s * rate))
    quiet = slice(max(0, start - round(_QUIET_S * rate)), max(start, 2))
    before = record.responses[:, quiet]
    return _Window(
        record,
        hit,
        level,
        record.force[start:stop] - np.median(record.force[quiet]),
        record.responses[:, start:stop] - before.mean(axis=1, keepdims=True),
        before.std(axis=1),
    )
