"""Plain peaks of the FRFs, and the lines around each of them cut out of every single hit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.fft import rfft

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.frf.windows import Windows
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.maxima import prominent_peaks
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]
Hits = Callable[[], Iterable[HitSamples]]
"""Gives the accepted hits, as often as it is called."""

PROMINENCE_DB = 6.0
"""A peak rises by so much out of the response of all FRFs: lower ones tell little of single hits."""

MAX_PEAKS = 24
"""Peaks followed from hit to hit, the most prominent first: more do not tell more of what moves."""

REACH = 4.0
"""Lines on either side of a peak, in half-power half-widths."""

FEWEST_LINES = 8
"""Lines on either side at least."""

MOST_LINES = 60
"""Lines on either side at most."""

MAX_OUTPUTS = 16
"""Responses kept of every hit, those that show the peak best."""


@dataclass(frozen=True)
class PeakWindow:
    """Lines around a peak.

    Attributes
    ----------
    lines : slice
        Of the FRFs' axis.
    pole : complex
        First guess, rad/s, under the exponential window.
    neighbours : complex ndarray
        Poles of other peaks that reach into the lines.
    outputs : ndarray of int
        Outputs of the FRF set that show the peak best.
    """

    lines: slice
    pole: complex
    neighbours: Complex
    outputs: NDArray[np.int64]


@dataclass(frozen=True)
class HitKey:
    """A hit by its file and number, with what the study of movement asks of it.

    Attributes
    ----------
    file : str
    number : int
    point : str
    force : float
        Size of the force peak.
    """

    file: str
    number: int
    point: str
    force: float

    @property
    def name(self) -> tuple[str, int]:
        """What tells a hit from all others."""
        return self.file, self.number


def peak_windows(
    frfs: FrfSet, band_hz: tuple[float, float], most: int | None = MAX_PEAKS
) -> tuple[PeakWindow, ...]:
    """The plain peaks of all FRFs together.

    Parameters
    ----------
    frfs : FrfSet
    band_hz : tuple of float
    most : int, optional
        Peaks at most, the most prominent ones; None for all.
    """
    level = np.array([[np.median(np.abs(frf[1:]) ** 2) for frf in row] for row in frfs.frf])
    curve = _response_curve(frfs, level)
    low, high = (int(k) for k in np.searchsorted(frfs.frequency_hz, band_hz))
    smooth = scipy.ndimage.gaussian_filter1d(curve, 1.0)
    found, rise = prominent_peaks(smooth[: high + 1], PROMINENCE_DB)
    inside = found > max(low, 1)
    found, rise = found[inside], rise[inside]
    kept = np.sort(found[np.argsort(-rise, kind="stable")[:most]])
    step = 2 * np.pi * float(frfs.frequency_hz[1])
    decay = np.array([max(_half_width(curve, k), 0.3) for k in kept]) * step
    poles = np.asarray(-decay + 1j * step * kept, dtype=np.complex128)
    return tuple(_window(frfs, level, poles, r, step) for r in range(len(poles)))


def peak_frfs(
    frfs: FrfSet, band_hz: tuple[float, float], most: int | None = MAX_PEAKS
) -> Iterator[tuple[PeakWindow, Complex, Real]]:
    """The same with the accelerances there, (n_inputs, n_outputs, n_lines), and the lines' frequencies, rad/s."""
    for window in peak_windows(frfs, band_hz, most):
        frf = frfs.accelerance(window.lines)[window.outputs].swapaxes(0, 1)
        yield window, frf, 2 * np.pi * frfs.frequency_hz[window.lines]


def _response_curve(frfs: FrfSet, level: Real) -> Real:
    """Power of all FRFs, each over its own median (n_outputs, n_inputs), in dB over the lines."""
    power = np.zeros(len(frfs.frequency_hz))
    for o, i in np.argwhere(np.isfinite(level) & (level > 0)):
        power += np.abs(frfs.frf[o, i]) ** 2 / level[o, i]
    return np.asarray(10 * np.log10(np.maximum(power, 1e-30)))


def _half_width(curve: Real, peak: int) -> float:
    """Half the width of a peak at half its power, in lines."""
    low = high = float(peak)
    target = curve[peak] - 10 * np.log10(2.0)
    for k in range(peak, 0, -1):
        if curve[k - 1] <= target:
            low = k - (curve[k] - target) / max(curve[k] - curve[k - 1], 1e-12)
            break
    for k in range(peak, len(curve) - 1):
        if curve[k + 1] <= target:
            high = k + (curve[k] - target) / max(curve[k] - curve[k + 1], 1e-12)
            break
    return 0.5 * (high - low)


def _window(frfs: FrfSet, level: Real, poles: Complex, index: int, step: float) -> PeakWindow:
    pole = complex(poles[index])
    half = int(np.clip(REACH * -pole.real / step, FEWEST_LINES, MOST_LINES))
    centre = round(pole.imag / step)
    lines = slice(max(1, centre - half), min(len(frfs.frequency_hz), centre + half + 1))
    distance = np.abs(poles.imag - pole.imag) / step
    near = (distance < 2 * half) & (np.arange(len(poles)) != index)
    power = np.nan_to_num(np.abs(frfs.frf[..., lines]) ** 2).sum(axis=-1)
    known = np.isfinite(level) & (level > 0)
    shown = np.where(known, power / np.where(known, level, 1.0), 0.0).sum(axis=1)
    outputs = np.sort(np.argsort(-shown, kind="stable")[:MAX_OUTPUTS])
    return PeakWindow(lines, pole, poles[near], outputs.astype(np.int64))


def spectra_of_hits(
    hits: Hits, frfs: FrfSet, settings: FrfSettings, windows: tuple[PeakWindow, ...]
) -> tuple[tuple[HitKey, ...], list[Complex]]:
    """Single-hit FRFs around every peak.

    Returns
    -------
    keys : tuple of HitKey
    spectra : list of complex ndarray, (n_hits, n_outputs, n_lines)
        Per window, as accelerance; NaN where a channel was left out.
    """
    keys: list[HitKey] = []
    stacked: list[list[Complex]] = [[] for _ in windows]
    place = {d.point: k for k, d in enumerate(frfs.outputs)}
    for hit in hits():
        keys.append(
            HitKey(hit.hit.file, hit.hit.number, hit.hit.impact.point, float(abs(hit.hit.peak_force)))
        )
        for found, part in zip(stacked, _one_hit(hit, settings, place, windows), strict=True):
            found.append(part)
    spectra = [np.array(found) for found in stacked]
    power = {"acceleration": 0, "velocity": 1, "displacement": 2}
    for window, values in zip(windows, spectra, strict=True):
        jw = 2j * np.pi * frfs.frequency_hz[window.lines]
        values *= np.array([jw ** power[frfs.quantities[o]] for o in window.outputs])
    return tuple(keys), spectra


def _one_hit(
    hit: HitSamples, settings: FrfSettings, place: dict[str, int], windows: tuple[PeakWindow, ...]
) -> list[Complex]:
    """Response over force of one hit, (n_outputs, n_lines) per window; NaN where a channel was left out."""
    prepared = Windows(hit, settings)
    force = np.asarray(rfft(prepared.force(hit.force))) * hit.hit.impact.sign
    safe = np.where(np.abs(force) > 0, force, 1.0)
    out = [np.full((len(w.outputs), w.lines.stop - w.lines.start), np.nan, dtype=complex) for w in windows]
    seen = [dict(zip(w.outputs.tolist(), range(len(w.outputs)), strict=True)) for w in windows]

    def read(row: int) -> None:
        channel = hit.channels[row]
        output = place[channel.dof.point]
        wanted = [k for k, rows in enumerate(seen) if output in rows]
        if not wanted:
            return
        samples = prepared.responses(np.asarray(hit.responses[row : row + 1]))[0]
        spectrum = channel.dof.sign * np.asarray(rfft(samples))
        for k in wanted:
            lines = windows[k].lines
            out[k][seen[k][output]] = spectrum[lines] / safe[lines]

    for _ in in_order(read, range(len(hit.channels))):
        pass
    return out
