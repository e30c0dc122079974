"""Frequency and damping over amplitude from the free decay after single hits: backbone and damping curves.

The response of all other modes, as fitted, is taken off, the sensors are combined by the mode's shape, and a
one-sided Gaussian filter about the mode leaves its analytic signal A(t) exp(jφ(t)). A decaying exponential passes
such a filter unchanged in shape, so that slopes of ln A and φ give decay rate and frequency without bias. They
are read in stretches over which the amplitude falls by a like factor.

References
----------
M. Feldman, "Non-linear system vibration analysis using Hilbert transform – I. Free vibration analysis method
'FREEVIB'", Mechanical Systems and Signal Processing 8(2), 1994.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import ifft, rfft

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.levels.differences import participations
from ema_pipeline.levels.single import output_shapes, windows_about
from ema_pipeline.levels.trend import Samples, Trend, trends
from ema_pipeline.levels.types import DecayCurve
from ema_pipeline.modal.basis import pole_values
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.processes import release_memory

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Hits = Callable[[], Iterable[HitSamples]]

BANDWIDTHS = 25.0
"""Width (1 sigma) of the Gaussian filter, in half-power half-widths of the mode; at least `FEWEST_LINES`."""

FEWEST_LINES = 4.0

WIDEST = 0.15
"""Largest width of the filter as a share of the mode's frequency."""

SETTLED = 3.0
"""Time from the hit, and to the end of the record, in standard deviations of the filter's response in time."""

STRETCHES = 8

OVERSAMPLING = 4
"""Samples used per independent one."""

FEWEST_SAMPLES = 3 * OVERSAMPLING
"""Samples per stretch at least."""

FLOOR = 6.0
"""Least amplitude over the noise."""

DEEPEST = 0.01
"""The decay is followed down to this share of its start: what is left of neighbours shows below."""

LEFT_OVER = 0.02
"""Share of the other modes' response that is taken to be left over after they were taken off."""

CUT = 5.0
"""The filter's reach in its width."""

FILTERED = 0.05
"""Error of frequency and decay rate that modes which were not identified make, in decay rates of the mode."""

HITS_PER_MODE = 2

DERIVATIVES = {"acceleration": 0, "velocity": 1, "displacement": 2}
"""How often a quantity is to be differentiated for an acceleration."""

MOST_MODES = 24
"""Modes analysed, those with the largest response first."""


@dataclass(frozen=True)
class _Task:
    """A mode to be read from a hit."""

    mode: int
    sensor: int


def decays(hits: Hits, frfs: FrfSet, modal: ModalModel) -> tuple[DecayCurve, ...]:
    """Backbone and damping curves of the modes, each from the hits that excite it most.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits.
    frfs : FrfSet
        Of all hits.
    modal : ModalModel
        Identified from `frfs`.

    Returns
    -------
    tuple of DecayCurve
        Only of modes that stand out of noise and neighbours long enough.
    """
    if not modal.modes:
        return ()
    decay = frfs.response_decay_rad_s
    poles = np.array([m.pole for m in modal.modes], dtype=np.complex128) - decay
    residues = _residues(frfs, modal, poles)  # (n_modes, n_outputs, n_inputs), accelerance
    release_memory()
    wanted = _tasks([(h.hit.impact.point, abs(h.hit.peak_force)) for h in hits()], frfs, poles, residues)
    found: list[DecayCurve] = []
    for number, hit in enumerate(hits()):
        tasks = wanted.get(number, [])
        if tasks:
            found += _of_hit(hit, tasks, frfs, poles, residues)
            release_memory()
    return tuple(sorted(found, key=lambda c: (c.mode, c.hit)))


def _residues(frfs: FrfSet, modal: ModalModel, poles: Complex) -> Complex:
    """Accelerance residues of every mode, fitted to the FRFs with the shapes given."""
    n_out, n_in = len(frfs.outputs), len(frfs.inputs)
    shapes = output_shapes(frfs, modal)
    out = np.zeros((len(poles), n_out, n_in), dtype=np.complex128)
    for window in windows_about(poles, frfs.frequency_hz):
        m, accelerance = window.modes, frfs.accelerance(window.lines)
        omega = 2 * np.pi * frfs.frequency_hz[window.lines]
        for i in range(n_in):
            seen = np.flatnonzero(frfs.hits[:, i] > 0)
            if not len(seen):
                continue
            shape = shapes[np.ix_(m, seen)]
            rest = frfs.record_s - float(frfs.delay_s[i])
            parts = participations(omega, accelerance[seen, i], poles[m], shape, rest)
            out[m[:, None], seen[None], i] = shape * parts[:, None]
    return out


def _tasks(
    struck: list[tuple[str, float]], frfs: FrfSet, poles: Complex, residues: Complex
) -> dict[int, list[_Task]]:
    """Which modes to read from which hits."""
    points = [d.point for d in frfs.inputs]
    size = np.abs(residues) / np.abs(poles.real)[:, None, None]  # height of the resonance
    place = np.array([points.index(p) for p, _ in struck])
    response = size.max(axis=1)[:, place] * np.array([f for _, f in struck])  # (n_modes, n_hits)
    out: dict[int, list[_Task]] = {}
    for mode in np.argsort(-response.max(axis=1))[:MOST_MODES]:
        for number in np.argsort(-response[mode])[:HITS_PER_MODE]:
            sensor = int(np.argmax(size[mode, :, place[number]]))
            out.setdefault(int(number), []).append(_Task(int(mode), sensor))
    return out


def _of_hit(
    hit: HitSamples, tasks: list[_Task], frfs: FrfSet, poles: Complex, residues: Complex
) -> list[DecayCurve]:
    """The curves of some modes after one hit."""
    n, rate = hit.force.size, hit.sample_rate_hz
    axis = np.asarray(np.fft.rfftfreq(n, 1 / rate))
    i = [d.point for d in frfs.inputs].index(hit.hit.impact.point)
    places = {d.point: o for o, d in enumerate(frfs.outputs)}
    outputs = [places[c.dof.point] for c in hit.channels]
    derivatives = np.array([DERIVATIVES[c.quantity] for c in hit.channels])
    bands = [_band(complex(poles[task.mode]), axis, n, rate) for task in tasks]
    weights = [
        _weights(
            residues[task.mode, outputs, i],
            np.array([frfs.variance[o, i, band.lines].mean() for o in outputs]),
        )
        for task, band in zip(tasks, bands, strict=True)
    ]
    combined = _combined(hit, bands, weights)
    force = np.asarray(rfft(hit.force)) * hit.hit.impact.sign
    start_s = (hit.hit.peak - hit.hit.start) / rate
    curves = []
    for task, band, weight, measured in zip(tasks, bands, weights, combined, strict=True):
        pole, lines, omega = complex(poles[task.mode]), band.lines, 2 * np.pi * band.axis
        u = pole_values(omega, poles, n / rate - start_s)
        mirrored = pole_values(omega, poles.conj(), n / rate - start_s)
        share = residues[:, outputs, i] @ weight
        other_share = residues[:, outputs, i].conj() @ weight
        mine = u[task.mode] * force[lines]
        others = (share @ u + other_share @ mirrored) * force[lines] - mine
        signal = measured - others
        scatter = np.zeros(len(omega))
        for o, gain, power in zip(outputs, np.abs(weight) ** 2, 2 * derivatives, strict=True):
            scatter += gain * frfs.hits[o, i] * frfs.variance[o, i, lines] * omega**power
        noise = band.noise(scatter * np.abs(force[lines]) ** 2, signal - mine)
        table = _read(band, signal, LEFT_OVER * others, noise, start_s, -FILTERED * pole.real)
        if table is not None:
            best = float(np.abs(residues[task.mode, task.sensor, i]))
            amplitude = table[0] * 2 * best / abs(pole) ** 2
            name = hit.hit.label
            curves.append(DecayCurve(task.mode, name, frfs.outputs[task.sensor], amplitude, *table[1:]))
    return curves


def _combined(hit: HitSamples, bands: list[_Band], weights: list[Complex]) -> list[Complex]:
    """Accelerations of all sensors with the weights of every band, (n_lines,) each; one spectrum is kept at a time."""
    out = [np.zeros(len(band.axis), dtype=np.complex128) for band in bands]
    for k, channel in enumerate(hit.channels):
        spectrum = np.asarray(rfft(np.asarray(hit.responses[k])))
        for band, weight, total in zip(bands, weights, out, strict=True):
            part = weight[k] * channel.dof.sign * spectrum[band.lines]
            for _ in range(DERIVATIVES[channel.quantity]):
                part *= 2j * np.pi * band.axis
            total += part
    return out


def _band(pole: complex, axis: Real, n: int, rate: float) -> _Band:
    """The lines and the filter about one mode."""
    width, centre = _width(pole, float(axis[1])), pole.imag / (2 * np.pi)
    first, stop = np.searchsorted(axis, [centre - CUT * width, centre + CUT * width])
    first = max(int(first), 1)
    return _Band(axis[first : int(stop)], first, n, rate, centre, width)


def _width(pole: complex, step_hz: float) -> float:
    """Width (1 sigma) of the filter, Hz."""
    frequency = pole.imag / (2 * np.pi)
    return float(min(max(-BANDWIDTHS * pole.real / (2 * np.pi), FEWEST_LINES * step_hz), WIDEST * frequency))


def _weights(own: Complex, noise: Real) -> Complex:
    """Combination of sensors with the best signal-to-noise ratio that gives the mode a share of 1."""
    known = np.isfinite(noise).all() and (noise > 0).all()  # one hit per point: no scatter is known
    weight = own.conj() / (noise if known else 1.0)
    return np.asarray(weight / np.sum(weight * own))


@dataclass(frozen=True)
class _Band:
    """Lines about one mode: their frequencies, the first one's number, and the filter."""

    axis: Real
    first: int
    n: int
    rate_hz: float
    centre: float
    width: float

    @property
    def lines(self) -> slice:
        """Numbers of the lines."""
        return slice(self.first, self.first + len(self.axis))

    @property
    def gain(self) -> Real:
        """The filter."""
        return np.asarray(np.exp(-0.5 * ((self.axis - self.centre) / self.width) ** 2))

    def analytic(self, spectrum: Complex) -> Complex:
        """Time signal of the filtered spectrum, positive frequencies alone."""
        full = np.zeros(self.n, dtype=np.complex128)
        full[self.first : self.first + len(spectrum)] = spectrum * self.gain
        return np.asarray(ifft(full))

    def noise(self, power: Real, left: Complex) -> float:
        """Standard deviation of the filtered signal.

        Parameters
        ----------
        power : ndarray, (n_lines,)
            Noise power of the lines from the scatter over hits; NaN where there is none.
        left : complex ndarray, (n_lines,)
            What no mode explains; taken in its place, in the last third of the record, where errors of the fit
            have decayed.
        """
        if np.isfinite(power).all():
            return float(np.sqrt(np.median(power) * np.sum(self.gain**2))) / self.n
        end = self.n - int(SETTLED / (2 * np.pi * self.width) * self.rate_hz)
        return float(np.sqrt(np.mean(np.abs(self.analytic(left)[2 * self.n // 3 : end]) ** 2)))


def _read(
    band: _Band, signal: Complex, others: Complex, noise: float, start_s: float, floor: float
) -> Real | None:
    """Amplitude, frequency, its std, damping and its std in stretches of the decay; None where too short.

    Parameters
    ----------
    band : _Band
    signal, others : complex ndarray, (n_lines,)
        Spectrum of the mode, and of what may be left of the other modes that were taken off.
    noise : float
        Standard deviation of the filtered signal.
    start_s : float
        Time of the hit.
    floor : float
        Systematic error of a slope, rad/s.

    Returns
    -------
    ndarray, (5, n_stretches)
    """
    g = band.analytic(signal)
    wrong = np.abs(np.gradient(band.analytic(others) / np.where(g == 0, 1.0, g)))
    settle = SETTLED / (2 * np.pi * band.width)
    if settle * band.rate_hz > band.n / 6:
        return None
    # one independent sample per equivalent noise bandwidth
    step = max(int(band.rate_hz / (OVERSAMPLING * band.width * np.sqrt(np.pi))), 1)
    place = np.arange(int((start_s + settle) * band.rate_hz), int(band.n - settle * band.rate_hz), step)
    amplitude = np.abs(g[place])
    faint = np.flatnonzero(amplitude < max(FLOOR * noise, DEEPEST * float(amplitude.max(initial=0.0))))
    stop = int(faint[0]) if len(faint) else len(place)
    if stop < 3 * FEWEST_SAMPLES or noise <= 0:
        return None
    place, amplitude = place[:stop], amplitude[:stop]
    time_s = place / band.rate_hz
    phase = np.unwrap(np.angle(g))[place]
    wrong = band.rate_hz * wrong[place]
    edges = np.round(np.linspace(0, stop, min(stop // FEWEST_SAMPLES, STRETCHES) + 1)).astype(int)
    rows = []
    for a, b in itertools.pairwise(edges):
        part = slice(a, b)
        weight = 2 * (amplitude[part] / noise) ** 2 / OVERSAMPLING  # of phase and of ln(amplitude)
        frequency, slope_std = _slope(time_s[part], phase[part], weight)
        rate, _ = _slope(time_s[part], np.log(amplitude[part]), weight)
        std = float(np.sqrt(slope_std**2 + np.mean(wrong[part] ** 2) + floor**2))
        s = complex(rate, frequency)
        mean = float(np.exp(np.average(np.log(amplitude[part]), weights=weight)))
        rows.append((mean, abs(s) / (2 * np.pi), std / (2 * np.pi), -s.real / abs(s), std / abs(s)))
    return np.array(rows).T


def _slope(time_s: Real, values: Real, weight: Real) -> tuple[float, float]:
    """Weighted slope and its standard deviation."""
    t = time_s - np.sum(weight * time_s) / weight.sum()
    strength = float(np.sum(weight * t**2))
    return float(np.sum(weight * t * values)) / strength, strength**-0.5


def decay_trends(
    curves: tuple[DecayCurve, ...], modes: tuple[int, ...]
) -> tuple[tuple[Trend, ...], tuple[Trend, ...]]:
    """Test the curves of every mode for frequency and damping that move with the amplitude.

    Parameters
    ----------
    curves : tuple of DecayCurve
    modes : tuple of int
        Modes to test.

    Returns
    -------
    frequency, damping : tuple of Trend
        NaN where a mode has no curve.
    """

    def of(mode: int, name: str) -> Samples:
        own = [c for c in curves if c.mode == mode]
        if not own:
            empty = np.zeros(0)
            return Samples(empty, empty, empty.astype(int), empty.astype(int), empty, empty)
        sheet = np.repeat(np.arange(len(own)), [len(c.amplitude_m) for c in own])
        amplitude = np.concatenate([c.amplitude_m for c in own])
        values = np.concatenate([getattr(c, name) for c in own])
        stds = np.concatenate(
            [getattr(c, name.replace("_hz", "_std_hz").replace("_ratio", "_std")) for c in own]
        )
        return Samples(
            values,
            stds**2,
            sheet,
            np.arange(len(values)),
            np.log(amplitude),
            (amplitude / amplitude.max()) ** 2,
        )

    found = trends([of(m, "frequency_hz") for m in modes] + [of(m, "damping_ratio") for m in modes])
    return found[: len(modes)], found[len(modes) :]
