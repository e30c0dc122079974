"""Mains hum taken off the hits in which it stands out, so that modes are identified without it.

Hum leaks into all lines around it, and a fit that has to leave it over knows the modes nearby far less well than the
hits tell of them. It does not decay, and is there before the blow: what is left of close modes beside a fit that is not
perfect may seem to last, but begins with the blow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.channel_checks import HUM_HZ
from ema_pipeline.ingest.pulse import find_pulse
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.lazy_samples import LazySamples
from ema_pipeline.modal.basis import pole_functions, pole_values
from ema_pipeline.modal.drift.windows import Hits
from ema_pipeline.modal.mains_hum import HARMONICS, MAINS_DRIFT, drifts, slow, tone_poles
from ema_pipeline.modal.types import ModalModel

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

HALF_WIDTH = 12
"""Lines looked at on either side of a tone, wherever the mains drifts to."""

REACH = 30
"""Lines beyond these within which a mode reaches into them."""

MOST_NEAR = 6
"""Modes that reach into the lines of a tone, above which too few lines are left to tell it from them."""

PLAIN = 20.0
"""Power of a tone over that of noise, mean of all hits, from which it is taken off: without hum it is 1 to 5."""

THERE_BEFORE = 0.5
"""Share of a tone that has to be there before the blow: 1 of hum, 0 of what begins with it."""

CERTAIN = 3.0
"""Standard deviations by which that has to be more than nothing."""

REST = 0.25
"""Share of the record before which no sample is looked at: the mains drifts."""

FEWEST_HITS = 4
"""Hits without which it is not known how these scatter."""

FEWEST_SAMPLES = 16
"""Before the blow; fewer tell nothing."""

BLOCK = 32
"""Channels transformed at once."""

_REFINED = np.linspace(-1, 1, 9)


@dataclass(frozen=True)
class _Tone:
    """A multiple of the mains' frequency, the lines around it, and the poles of modes that reach into them."""

    hz: float
    lines: slice
    poles: Complex


@dataclass(frozen=True)
class _Found:
    """Tones of one hit, (n_tones, n_channels).

    `gain` is their power over that of noise. `before` are their products with each other before the blow, (n_tones,
    n_tones, n_channels), and `shown` those with the samples there, both over the power of these.
    """

    poles: Complex
    sizes: Complex
    gain: Real
    before: Real
    shown: Real
    points: tuple[str, ...]


@dataclass(frozen=True)
class Hum:
    """Tones that stand out of the hits.

    Attributes
    ----------
    hz : tuple of float
        Multiples of the mains' frequency.
    sizes : dict of (str, int) to complex ndarray, (n_channels, n_tones)
        Of every hit by its file and number: of the transform of exp(st), so that the tone is 2 Re(size·exp(st)) times
        the time between samples.
    poles : dict of (str, int) to complex ndarray, (n_tones,)
        s, rad/s.
    """

    hz: tuple[float, ...]
    sizes: dict[tuple[str, int], Complex]
    poles: dict[tuple[str, int], Complex]

    def taken_off(self, hits: Hits) -> Hits:
        """The hits without these tones."""

        def cleaned() -> Iterator[HitSamples]:
            for hit in hits():
                key = hit.hit.file, hit.hit.number
                less = _WithoutTones(hit, self.sizes[key], self.poles[key])
                yield replace(hit, responses=less)

        return cleaned

    @property
    def note(self) -> str:
        """What was done."""
        named = ", ".join(f"{hz:g}" for hz in self.hz)
        return f"mains hum at {named} Hz was taken off every hit before modes were identified"


class _WithoutTones(LazySamples):
    """Responses of a hit less tones that last for the whole record."""

    def __init__(self, hit: HitSamples, sizes: Complex, poles: Complex) -> None:
        self._whole, self._sizes, self._poles = hit.responses, sizes, poles
        self._step_s = 1 / hit.sample_rate_hz
        self.shape = hit.responses.shape[0], hit.responses.shape[1]

    def read(self, row: int, start: int, stop: int) -> Real:
        """Samples ``start:stop`` of one channel."""
        time = self._step_s * np.arange(start, stop)
        tones = sum(
            size * np.exp(pole * time) for size, pole in zip(self._sizes[row], self._poles, strict=True)
        )
        return np.asarray(self._whole[row, start:stop] - 2 * self._step_s * np.real(tones))


def hum_of(modal: ModalModel, hits: Hits, frfs: FrfSet) -> Hum | None:
    """Tones at multiples of the mains' frequency that stand out of the hits beside the modes; None without any.

    Parameters
    ----------
    modal : ModalModel
        Without modes that are hum.
    hits : callable
        Gives the accepted hits, as they were recorded.
    frfs : FrfSet
        Of these hits.
    """
    tones = _tones(modal, frfs)
    if not tones:
        return None
    keys, found = [], []
    for hit in hits():
        keys.append((hit.hit.file, hit.hit.number))
        found.append(_read(hit, tones))
    if len(found) < FEWEST_HITS:
        return None
    points = dict.fromkeys(p for one in found for p in one.points)
    place = {point: k for k, point in enumerate(points)}
    rows = [[place[p] for p in one.points] for one in found]
    plain = _plain(found, rows, len(place))
    if not plain.any():
        return None
    taken = np.flatnonzero(plain.any(axis=1))
    sizes = [np.where(plain[:, r], one.sizes, 0)[taken].T for one, r in zip(found, rows, strict=True)]
    return Hum(
        tuple(tones[k].hz for k in taken),
        dict(zip(keys, sizes, strict=True)),
        {key: one.poles[taken] for key, one in zip(keys, found, strict=True)},
    )


def _tones(modal: ModalModel, frfs: FrfSet) -> list[_Tone]:
    """Multiples of 50 and 60 Hz within the band."""
    step = float(frfs.frequency_hz[1])
    poles = np.array([m.pole for m in modal.modes], dtype=np.complex128)
    low, high = modal.band_hz
    tones = []
    for hz in sorted({mains * k for mains in HUM_HZ for k in range(1, HARMONICS + 1)}):
        half = HALF_WIDTH + int(np.ceil(MAINS_DRIFT * hz / step))
        if low + half * step < hz < high - half * step:
            centre = round(hz / step)
            near = np.abs(poles.imag / (2 * np.pi) - hz) < (half + REACH) * step
            if np.count_nonzero(near) <= MOST_NEAR:
                tones.append(_Tone(hz, slice(max(1, centre - half), centre + half + 1), poles[near]))
    return tones


def _read(hit: HitSamples, tones: Sequence[_Tone]) -> _Found:
    """Tones of one hit: those of one drift of the mains that stands out most of all channels."""
    record_s, count = hit.force.size / hit.sample_rate_hz, len(hit.channels)
    delay_s = (hit.hit.peak - hit.hit.start) / hit.sample_rate_hz
    lines = [np.empty((t.lines.stop - t.lines.start, count), dtype=np.complex128) for t in tones]
    for start in range(0, count, BLOCK):
        rows = slice(start, min(start + BLOCK, count))
        spectra = np.asarray(rfft(np.asarray(hit.responses[rows])))
        for tone, values in zip(tones, lines, strict=True):
            values[:, rows] = spectra[:, tone.lines].T
    beside = [_Beside(t, v, hit, record_s, delay_s) for t, v in zip(tones, lines, strict=True)]

    def gain(drift: Real) -> Real:
        return np.sum([one.at(drift)[1].sum(axis=1) for one in beside], axis=0)

    tried = drifts(tones[-1].hz, record_s)
    step = tried[1] - tried[0]
    drift = tried[np.argmax(gain(tried))]
    for _ in range(2):  # to a sixteenth of the first step
        nearer = drift + step * _REFINED
        drift, step = nearer[np.argmax(gain(nearer))], step * (_REFINED[1] - _REFINED[0])
    best = [one.at(np.array([drift])) for one in beside]
    sizes, gains = (np.array([b[k][0] for b in best]) for k in (0, 1))
    poles = np.array([one.poles(np.array([drift]))[0] for one in beside])
    return _Found(poles, sizes, gains, *_before(hit, sizes, poles), tuple(c.dof.point for c in hit.channels))


def _before(hit: HitSamples, sizes: Complex, poles: Complex) -> tuple[Real, Real]:
    """Products of tones before the blow with each other and with the samples there, over the power of these."""
    blow = find_pulse(hit.force, hit.hit.peak - hit.hit.start).start
    count = 0 if hit.before is None else hit.before.shape[1]
    first = max(count - int(REST * hit.force.size), 0)
    samples = np.asarray(hit.responses[:, :blow])
    if hit.before is not None:
        samples = np.concatenate([hit.before[:, first:], samples], axis=1)
    if samples.shape[1] < FEWEST_SAMPLES:
        return np.zeros((len(sizes), *sizes.shape)), np.zeros(sizes.shape)
    step_s = 1 / hit.sample_rate_hz
    time = step_s * (np.arange(samples.shape[1]) - (count - first))
    functions = np.exp(poles[:, None] * time)
    waves = np.concatenate([functions.real, -functions.imag])
    waves -= waves.mean(axis=1, keepdims=True)
    samples = samples - samples.mean(axis=1, keepdims=True)
    power = np.maximum(np.mean(samples**2, axis=1), 1e-300)
    parts = 2 * step_s * np.array([sizes.real, sizes.imag])
    among = (waves @ waves.T).reshape(2, len(poles), 2, len(poles))
    products = np.einsum("akc,akbj,bjc->kjc", parts, among, parts, optimize=True)
    shown = np.sum(parts * (waves @ samples.T).reshape(parts.shape), axis=0)
    return products / power, shown / power


class _Beside:
    """Lines of a hit about one tone, beside all that begins with the blow: modes, also those that moved a little."""

    def __init__(
        self, tone: _Tone, values: Complex, hit: HitSamples, record_s: float, delay_s: float
    ) -> None:
        self._hz, self._record_s, self._window = tone.hz, record_s, hit.window_decay_rad_s
        self._omega = 2 * np.pi * np.arange(tone.lines.start, tone.lines.stop) / record_s
        functions = pole_functions(self._omega, tone.poles - self._window, record_s - delay_s)
        decays = np.exp(-1j * self._omega * delay_s) * np.concatenate(functions)
        background = np.column_stack([slow(self._omega, delay_s), *decays])
        self._basis = np.linalg.qr(background / np.linalg.norm(background, axis=0))[0]
        self._left = self._beside(values)
        self._free = max(len(self._omega) - background.shape[1] - 1, 1)

    def poles(self, drift: Real) -> Complex:
        """Of the tone at drifts of the mains."""
        return tone_poles(self._hz, drift, self._record_s, self._window)

    def at(self, drift: Real) -> tuple[Complex, Real]:
        """Sizes of the tone, and its power over that of what is left beside it, (n_drifts, n_channels)."""
        tones = self._beside(pole_values(self._omega, self.poles(drift), self._record_s).T)
        power = np.sum(np.abs(tones) ** 2, axis=0)[:, None]
        sizes = (tones.conj().T @ self._left) / power
        explained = np.abs(sizes) ** 2 * power
        noise = (np.sum(np.abs(self._left) ** 2, axis=0) - explained) / self._free
        return sizes, explained / np.maximum(noise, 1e-12 * explained + 1e-300)

    def _beside(self, values: Complex) -> Complex:
        return np.asarray(values - self._basis @ (self._basis.conj().T @ values))


def _plain(found: Sequence[_Found], rows: Sequence[list[int]], count: int) -> NDArray[np.bool_]:
    """Tones that stand out and are there before the blow, (n_tones, n_points).

    Parameters
    ----------
    found : sequence of _Found
    rows : sequence of list of int
        Of every hit: which of the `count` points its channels are at.
    count : int
    """
    gain = np.full((len(found), len(found[0].poles), count), np.nan)
    for of_hit, one, here in zip(gain, found, rows, strict=True):
        of_hit[:, here] = one.gain
    plain = np.nan_to_num(np.nanmean(gain, axis=0)) >= PLAIN
    at = np.flatnonzero(plain.any(axis=1))
    plain[at] &= _there_before(found, rows, plain, at)[:, None]
    return np.asarray(plain)


def _there_before(
    found: Sequence[_Found], rows: Sequence[list[int]], plain: NDArray[np.bool_], at: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Which tones of those `at` are in the samples before the blow as well, by the channels where they are plain."""
    n, seen = len(at), [plain[at][:, r] for r in rows]
    products = np.array(
        [
            np.sum(one.before[np.ix_(at, at)] * s[:, None] * s, axis=2)
            for one, s in zip(found, seen, strict=True)
        ]
    ).reshape(len(found), n, n)
    shown = np.array([np.sum(one.shown[at] * s, axis=1) for one, s in zip(found, seen, strict=True)])
    inverse = np.linalg.pinv(products.sum(axis=0), hermitian=True)
    share = inverse @ shown.sum(axis=0)
    # as hits scatter: what rings on from an earlier blow is no white noise
    left = (shown - products @ share) @ inverse
    std = np.sqrt(np.sum(left**2, axis=0) * len(found) / (len(found) - 1))
    return np.asarray((share > THERE_BEFORE) & (share > CERTAIN * std))
