"""Poles of every single hit, as small differences from what all hits of its point show together.

What a fit of modes to FRFs leaves over (far modes, leakage, small errors of the shapes) is the same in every hit
of a point. So not the FRFs themselves are fitted, but the difference of each hit's FRFs from the mean over its
point's hits, with the derivatives of the modes by their poles and participations. Whatever is systematic
cancels, and what is left over is noise, whose size it tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import uniform_filter1d

from ema_pipeline.dof import Dof
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.frf.windows import Windows, decay_rate, pulse_alone
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.levels.differences import DEAF, UNKNOWN, participations, solve
from ema_pipeline.levels.types import Pulses
from ema_pipeline.modal.types import ModalModel

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Hits = Callable[[], Iterable[HitSamples]]

REACH = 8.0
"""Half-power half-widths on either side of a mode that tell its pole."""

FEWEST_LINES = 12
"""Lines on either side at least."""

CLEAR_FORCE = 100.0
"""Force power over the hammer's noise, below which the FRF of a single hit is biased."""


SMOOTH_LINES = 9
"""Lines over which the power of the force is averaged."""


@dataclass(frozen=True)
class HitPoles:
    """Poles of every mode in every single hit.

    Attributes
    ----------
    names : tuple of str
        ``file#number``.
    point : ndarray of int, (n_hits,)
        Index of the impact point.
    sheet : ndarray of int, (n_hits,)
        Hits of one sheet share impact point and sensors: only their differences mean something.
    force_n : ndarray, (n_hits,)
        Peak force.
    frequency_hz, frequency_std_hz, damping_ratio, damping_std : ndarray, (n_hits, n_modes)
        Standard deviations from noise alone; ``inf`` where a hit tells nothing of the mode.
    motion_m : complex ndarray, (n_hits, n_modes)
        Displacement amplitude just after the hit where the mode's shape is 1, with the phase that it has then; NaN for
        an uncalibrated hammer.
    amplitude_m : ndarray, (n_hits, n_modes)
        Largest displacement amplitude at any sensor just after the hit; NaN for an uncalibrated hammer.
    size : complex ndarray, (n_hits, n_modes)
        Participation: the residues over the shape, which a linear mode has alike in all hits of a point.
    size_std : ndarray, (n_hits, n_modes)
        From noise alone, of real and imaginary part; ``inf`` where a hit tells nothing.
    pulses : Pulses or None
        None for an uncalibrated hammer, and where hits were sampled at different rates.
    """

    names: tuple[str, ...]
    point: NDArray[np.int64]
    sheet: NDArray[np.int64]
    force_n: Real
    frequency_hz: Real
    frequency_std_hz: Real
    damping_ratio: Real
    damping_std: Real
    motion_m: Complex
    amplitude_m: Real
    size: Complex
    size_std: Real
    pulses: Pulses | None = None


@dataclass(frozen=True)
class Window:
    """Lines and the modes among them: `lines` of the FRFs' axis, `modes` as indices."""

    lines: slice
    modes: NDArray[np.int64]


@dataclass(frozen=True)
class _Hit:
    """What is kept of one hit: accelerance and power of the force in each window; at each mode, the force and
    whether it is clear of the hammer's noise. The force's phase counts from the blow. The pulse as recorded, and its
    samples before the peak.
    """

    name: str
    force_n: float
    rest_s: float
    frf: tuple[Complex, ...]
    power: tuple[Real, ...]
    impulse: Complex
    heard: NDArray[np.bool_]
    calibrated: bool
    struck: Dof
    rate_hz: float
    before_peak: int
    pulse: Real


def single_hits(hits: Hits, modal: ModalModel, frfs: FrfSet, frf_settings: FrfSettings) -> HitPoles:
    """Poles of every mode in every single hit.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits.
    modal : ModalModel
        Modes to look for; poles and shapes where the linearisation starts.
    frfs : FrfSet
        Of all hits, for their axis and exponential window.
    frf_settings : FrfSettings
    """
    decay = frfs.response_decay_rad_s
    poles = np.array([m.pole for m in modal.modes], dtype=np.complex128) - decay
    windows = windows_about(poles, frfs.frequency_hz)
    frequency = np.abs(poles) / (2 * np.pi)
    sheets: dict[tuple[str, tuple[str, ...]], list[tuple[int, _Hit]]] = {}
    in_order: list[_Hit] = []
    for hit in hits():
        one = estimate_frfs([hit], frf_settings)
        key = (one.inputs[0].point, tuple(d.point for d in one.outputs))
        in_order.append(_spectra(hit, one, windows, frequency, frf_settings))
        sheets.setdefault(key, []).append((len(in_order) - 1, in_order[-1]))
    count = len(in_order)
    shape = (count, len(poles))
    names, force = [""] * count, np.zeros(count)
    point, sheet = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    pole, std = np.tile(poles, (count, 1)), np.full(shape, np.inf)
    amplitude, motion = np.full(shape, np.nan), np.full(shape, np.nan, dtype=np.complex128)
    size, size_std = np.zeros(shape, dtype=np.complex128), np.full(shape, np.inf)
    places = [d.point for d in frfs.inputs]
    dofs = [d.point for d in frfs.outputs]
    shapes = output_shapes(frfs, modal)
    for number, ((struck, outputs), found) in enumerate(sheets.items()):
        index = np.array([i for i, _ in found])
        members = [h for _, h in found]
        for i, h in found:
            names[i], force[i] = h.name, h.force_n
        point[index], sheet[index] = places.index(struck), number
        seen = shapes[:, [dofs.index(o) for o in outputs]]
        for k, window in enumerate(windows):
            omega = 2 * np.pi * frfs.frequency_hz[window.lines]
            m = window.modes
            solved = solve(omega, [h.frf[k] for h in members], np.array([h.power[k] for h in members]),
                            poles[m], seen[m], float(np.mean([h.rest_s for h in members])))  # fmt: skip
            pole[np.ix_(index, m)] = solved.poles
            known = solved.std < -UNKNOWN * poles[m].real
            known &= np.array([h.heard[m] for h in members])
            std[np.ix_(index, m)] = np.where(known, solved.std, np.inf)
            heard = np.array([h.heard[m] for h in members])
            size[np.ix_(index, m)] = solved.participation
            size_std[np.ix_(index, m)] = np.where(heard, solved.participation_std, np.inf)
            if members[0].calibrated:
                impulse = np.array([h.impulse[m] for h in members])
                participation = np.where(known, solved.participation, solved.mean_participation)
                moved = 2 * participation * impulse / poles[m] ** 2
                motion[np.ix_(index, m)] = moved
                amplitude[np.ix_(index, m)] = np.abs(moved) * np.abs(seen[m]).max(axis=1)
    physical = pole + decay
    return HitPoles(
        tuple(names), point, sheet, force,
        np.abs(physical) / (2 * np.pi), std / (2 * np.pi),
        -physical.real / np.abs(physical), std / np.abs(physical), motion, amplitude, size, size_std,
        _pulses(in_order),
    )  # fmt: skip


def _pulses(hits: Sequence[_Hit]) -> Pulses | None:
    """The pulses of all hits, their peaks at one sample."""
    if not all(h.calibrated and h.rate_hz == hits[0].rate_hz for h in hits):
        return None
    before = max((h.before_peak for h in hits), default=0)
    after = max((len(h.pulse) - h.before_peak for h in hits), default=0)
    force = np.zeros((len(hits), before + after))
    for row, h in zip(force, hits, strict=True):
        start = before - h.before_peak
        row[start : start + len(h.pulse)] = h.pulse
    return Pulses(tuple(h.struck for h in hits), force, before, hits[0].rate_hz if hits else 0.0)


def windows_about(poles: Complex, frequency_hz: Real) -> tuple[Window, ...]:
    """Lines about every pole, joined where they overlap."""
    step = float(frequency_hz[1] - frequency_hz[0])
    order = np.argsort(poles.imag)
    parts: list[tuple[int, int, list[int]]] = []
    for r in order:
        centre = poles[r].imag / (2 * np.pi) / step
        half = max(REACH * -poles[r].real / (2 * np.pi) / step, FEWEST_LINES)
        first, stop = max(int(centre - half), 1), min(int(centre + half) + 1, len(frequency_hz))
        if parts and first < parts[-1][1]:
            start, end, inside = parts[-1]
            parts[-1] = (min(start, first), max(end, stop), [*inside, int(r)])
        else:
            parts.append((first, stop, [int(r)]))
    return tuple(Window(slice(a, b), np.array(m, dtype=np.int64)) for a, b, m in parts)


def output_shapes(frfs: FrfSet, modal: ModalModel) -> Complex:
    """Shapes at the outputs, (n_modes, n_outputs); fitted to the FRFs where the modal model lacks them.

    It lacks them for a roving hammer without a driving point, whose shapes are those of the impact points.
    """
    places = {d.point: k for k, d in enumerate(modal.dofs)}
    if all(d.point in places for d in frfs.outputs):
        return np.nan_to_num(
            np.array([m.shape for m in modal.modes])[:, [places[d.point] for d in frfs.outputs]]
        )
    poles = np.array([m.pole for m in modal.modes], dtype=np.complex128) - frfs.response_decay_rad_s
    residues = np.zeros((len(poles), len(frfs.outputs), len(frfs.inputs)), dtype=np.complex128)
    accelerance = frfs.accelerance()
    for window in windows_about(poles, frfs.frequency_hz):
        omega, m = 2 * np.pi * frfs.frequency_hz[window.lines], window.modes
        for o, i in np.argwhere(frfs.hits > 0):
            frf = accelerance[o, i, window.lines][None]
            rest = frfs.record_s - float(frfs.delay_s[i])
            residues[m, o, i] = participations(omega, frf, poles[m], np.ones((len(m), 1), complex), rest)
    return np.array([np.linalg.svd(r)[0][:, 0] for r in residues])


def excitation(found: HitPoles) -> Real:
    """Amplitude per force at each hit's point, (n_hits, n_modes): the median over the point's hits."""
    ratio = found.amplitude_m / found.force_n[:, None]
    if not np.isfinite(ratio).any():  # uncalibrated hammer
        return np.ones(ratio.shape)
    out = np.zeros(ratio.shape)
    for p in np.unique(found.point):
        out[found.point == p] = np.nanmedian(ratio[found.point == p], axis=0)
    return out


def _spectra(
    hit: HitSamples, one: FrfSet, windows: tuple[Window, ...], frequency_hz: Real, settings: FrfSettings
) -> _Hit:
    """Cut what the windows need out of one hit."""
    prepared = Windows(hit, settings)
    force = np.asarray(rfft(prepared.force(hit.force))) / hit.sample_rate_hz
    line = np.clip(np.rint(frequency_hz * one.record_s).astype(int), 0, len(force) - 1)
    # differences of neighbouring samples: the pulse is short, and drift does not count
    noise = np.median(np.abs(np.diff(hit.force))) / (0.6745 * np.sqrt(2)) / hit.sample_rate_hz
    # smoothed, so that a line's noise has no part in its own weight: that would bias the fit
    power = uniform_filter1d(np.abs(force) ** 2, SMOOTH_LINES, mode="nearest")
    clear = CLEAR_FORCE * noise**2 * hit.force.size
    heard = power[line] > clear
    power = np.where(power > clear, power, DEAF)
    acc = one.accelerance()[:, 0]
    window_decay = decay_rate(settings, one.record_s)
    peak = hit.hit.peak - hit.hit.start
    first, pulse = pulse_alone(hit.force, peak)
    return _Hit(
        hit.hit.label,
        abs(hit.hit.peak_force),
        max(one.record_s - float(one.delay_s[0]), 0.5 * one.record_s),
        tuple(acc[:, w.lines].copy() for w in windows),
        tuple(power[w.lines] for w in windows),
        force[line] * np.exp((2j * np.pi * frequency_hz + window_decay) * float(one.delay_s[0])),
        heard,
        hit.force_calibrated,
        hit.hit.impact,
        hit.sample_rate_hz,
        peak - first,
        pulse,
    )
