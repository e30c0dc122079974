"""Hits to FRFs in one pass: spectra are accumulated, no hit is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import uniform_filter1d

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.channel_faults import EXCHANGED, SENSITIVITY
from ema_pipeline.frf.channels import ChannelQuality, merged
from ema_pipeline.frf.checks import check_frfs
from ema_pipeline.frf.parts import joined
from ema_pipeline.frf.points import POINT, check_points
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.signs import HitLines, check_signs, strongest_lines
from ema_pipeline.frf.types import FrfSet, unknown
from ema_pipeline.frf.warp import WarpedTransform
from ema_pipeline.frf.windows import Windows, decay_rate
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.processes import release_memory

Shifts = Callable[[HitSamples], NDArray[np.float64]]
"""Relative shift of frequency of a hit at every line, (n_lines,): line k is read at k·(1 + shift)."""

BLOCK = 2
"""Channels transformed at a time: their spectra stay in the processor's cache."""

NOTHING = 1e-28
"""Share of the largest force autospectrum that rounding alone makes."""

BAND_OVER_RATE = 1 / 2.56
"""Converters' anti-alias filters are flat up to the sample rate over 2.56."""

SAFE_DROP_DB = 20.0
"""A force spectrum within this of its largest is strong enough, whatever its noise (as ISO 7626-5 asks)."""

FLOOR_DB = 10.0
"""Distance from the hammer's noise at which a force spectrum still serves."""

STRONG_SHARE = 0.8
"""Least share of lines with enough force up to the band's end; the rest lies in zeros of the spectrum."""


def estimate_frfs(
    hits: Iterable[HitSamples],
    settings: FrfSettings | None = None,
    shifts: Shifts | None = None,
    *,
    coherence: bool = True,
) -> FrfSet:
    """Estimate FRFs, coherence and variance from hits.

    With F the force and Y the response spectra (rectangular window unless set otherwise) and sums over hits,
    H1 = ΣYF*/Σ|F|², H2 = Σ|Y|²/ΣFY*, Hv their geometric mean with the phase of H1; coherence
    γ² = |ΣYF*|²/(Σ|F|² Σ|Y|²) [1]_.

    Variance of H1: given the forces, H1 is the least-squares slope of Y on F. The residual
    R = Σ|Y - H1·F|² = Σ|Y|²(1 - γ²) of n hits has n - 1 complex degrees of freedom, so that R/(n - 1) is
    unbiased for the noise power and E|H - E H|² = R/((n - 1) Σ|F|²), that is |H|²(1 - γ²)/((n - 1) γ²);
    [1]_ has n in place of n - 1. A single line gives it but 2(n - 1) real degrees of freedom; the noise
    power R is therefore averaged over neighbouring lines, as few as give `variance_dof` complex degrees of
    freedom. For H2 and Hv the relative variance of H1 is taken.

    The band runs from the first line to the last at which the force autospectrum (median over 1/256 of the
    lines) stands above the hammer's noise and is not `band_drop_db` below its largest, narrow zeros of the
    spectrum aside, for nine tenths of all inputs, and at most to the sample rate over 2.56.

    Hits of different parts of a test (two hammers, two sets of sensors) are averaged part by part; `parts.joined`
    puts the parts together.

    Parameters
    ----------
    hits : iterable of HitSamples
        Accepted hits of one configuration, gone through once, one at a time.
    settings : FrfSettings, optional
    shifts : callable, optional
        Gives the shift of frequency of each hit, so that hits whose frequencies have moved are averaged where
        they belong together.
    coherence : bool
        False where neither coherence nor checks are asked for: a third less memory.

    Returns
    -------
    FrfSet
        Outputs and inputs in order of appearance, pairs that were not measured NaN.

    Raises
    ------
    EmaError
        Where there is no hit; where hits differ in length, sample rate, calibration, exponential window or in
        the quantity of one output; where two channels of a hit measure one DOF; where a force is zero throughout.

    References
    ----------
    .. [1] J. S. Bendat and A. G. Piersol, Random Data: Analysis and Measurement Procedures, 4th ed.,
       Wiley, 2010, sections 6.1, 9.2.
    """
    settings = settings or FrfSettings()
    totals: dict[str, _Total] = {}
    with ThreadPoolExecutor(settings.threads) as pool:
        for hit in hits:
            total = totals.setdefault(hit.hit.part, _Total())
            single = total.pairs if coherence else None
            _accumulate(total.sheet_of(hit), hit, settings, shifts, pool, single)
        parts = {
            name: _finish(total, total.first, settings, pool, coherence)
            for name, total in totals.items()
            if total.first is not None
        }
    if not parts:
        raise EmaError("no accepted hit: there is nothing to estimate FRFs from; see the hits' verdicts")
    frfs = joined(parts)
    if not coherence:
        return frfs
    of_hits = [v for name, part in parts.items() for v in _of_single_hits(totals[name], part)]
    rest = check_frfs(frfs, settings)
    misplaced = any(v.check == POINT and not v.passes for v in of_hits)
    if misplaced:  # reciprocity then tells of no sensor
        rest = tuple(v for v in rest if v.check not in (SENSITIVITY, EXCHANGED))
    return replace(frfs, verdicts=(*of_hits, *rest))


def _of_single_hits(total: _Total, frfs: FrfSet) -> list[CheckResult]:
    low, high = np.searchsorted(frfs.frequency_hz, frfs.band_hz)
    band = int(low), int(high)
    signs = check_signs(total.pairs, total.outputs, total.quantities, band)
    return [*signs, *check_points(total.pairs, frfs, band)]


@dataclass
class _Sheet:
    """Sums over all hits on one point in which the same channels were used."""

    impact: str
    outputs: tuple[str, ...]
    cross: NDArray[np.complex128]
    auto: NDArray[np.float64]
    force: NDArray[np.float64]
    hits: int = 0


@dataclass
class _Total:
    """All sheets, and what must be equal in all hits."""

    sheets: dict[tuple[str, tuple[str, ...]], _Sheet] = field(default_factory=dict)
    outputs: dict[str, Dof] = field(default_factory=dict)
    inputs: dict[str, Dof] = field(default_factory=dict)
    quantities: dict[str, str] = field(default_factory=dict)
    masses: dict[str, float] = field(default_factory=dict)
    delays: dict[str, list[float]] = field(default_factory=dict)
    channels: dict[str, ChannelQuality] = field(default_factory=dict)
    hammer: ChannelQuality | None = None
    pairs: dict[tuple[str, str], HitLines] = field(default_factory=dict)
    first: HitSamples | None = None
    rings_on: bool = False

    def sheet_of(self, hit: HitSamples) -> _Sheet:
        """The sheet that a hit goes to, new where needed."""
        where = f"{hit.hit.file}, hit {hit.hit.number}"
        self._check(hit, where)
        if self.first is None:
            # Only its length, rate and calibration are needed: the samples must not be held.
            self.first = replace(hit, responses=np.empty((0, 0)), channels=())
        points = tuple(c.dof.point for c in hit.channels)
        if len(set(points)) < len(points):
            twice = next(p for p in points if points.count(p) > 1)
            names = [c.name for c in hit.channels if c.dof.point == twice]
            raise EmaError(
                f"{where}: channels '{names[0]}' and '{names[1]}' both measure {twice}; correct a dof"
            )
        for channel in hit.channels:
            point = channel.dof.point
            known = self.quantities.setdefault(point, channel.quantity)
            if known != channel.quantity:
                raise EmaError(
                    f"{where}: channel '{channel.name}' measures {channel.quantity} at {point}, other hits "
                    f"{known}; put them into separate tests"
                )
            self.outputs.setdefault(point, replace(channel.dof, sign=1))
            self.masses[point] = max(self.masses.get(point, 0.0), channel.sensor_mass_kg)
            self.channels[point] = merged(
                self.channels.get(point),
                ChannelQuality(channel.name, channel.calibration_std, channel.transverse),
            )
        self.hammer = merged(
            self.hammer, ChannelQuality(hit.force_name, hit.force_calibration_std, hit.force_transverse)
        )
        self.rings_on |= hit.hit.rings_on
        impact = hit.hit.impact
        self.inputs.setdefault(impact.point, replace(impact, sign=1))
        self.delays.setdefault(impact.point, []).append((hit.hit.peak - hit.hit.start) / hit.sample_rate_hz)
        key = (impact.point, points)
        if key not in self.sheets:
            lines = hit.force.size // 2 + 1
            self.sheets[key] = _Sheet(
                impact.point,
                points,
                np.zeros((len(points), lines), dtype=np.complex128),
                np.zeros((len(points), lines)),
                np.zeros(lines),
            )
        return self.sheets[key]

    def _check(self, hit: HitSamples, where: str) -> None:
        first = self.first
        if first is None:
            return
        if hit.force.size != first.force.size:
            raise EmaError(
                f"{where}: {hit.force.size} samples, but {first.force.size} in '{first.hit.file}'; "
                "hits of one configuration must be equally long"
            )
        if hit.sample_rate_hz != first.sample_rate_hz:
            raise EmaError(
                f"{where}: sample rate {hit.sample_rate_hz:.10g} Hz, but {first.sample_rate_hz:.10g} Hz in "
                f"'{first.hit.file}'; put them into separate tests"
            )
        if hit.force_calibrated != first.force_calibrated:
            raise EmaError(
                f"{where}: the hammer is calibrated in only one of this and '{first.hit.file}'; "
                "state its sensitivity"
            )
        if hit.window_decay_rad_s != first.window_decay_rad_s:
            raise EmaError(
                f"{where}: was recorded with an exponential window of {hit.window_decay_rad_s:g} rad/s, "
                f"'{first.hit.file}' with {first.window_decay_rad_s:g} rad/s; put them into separate tests"
            )


def _accumulate(
    sheet: _Sheet,
    hit: HitSamples,
    settings: FrfSettings,
    shifts: Shifts | None,
    pool: ThreadPoolExecutor,
    pairs: dict[tuple[str, str], HitLines] | None,
) -> None:
    """Add one hit to the sums, and its FRFs at a few lines to `pairs`; blocks of channels go to the threads."""
    shift = None if shifts is None else shifts(hit)
    moved = shift is not None and bool(np.any(shift))
    windows = Windows(hit, settings, offsets=moved)
    transform: Callable[[NDArray[np.float64]], NDArray[np.complex128]] = (
        WarpedTransform(hit.force.size, shift) if shift is not None and moved else rfft
    )
    spectrum = np.asarray(transform(windows.force(hit.force)))
    power = spectrum.real**2 + spectrum.imag**2
    if not power[1:].any():
        raise EmaError(f"{hit.hit.file}, hit {hit.hit.number}: the force is constant; leave the hit out")
    sheet.force += power
    sheet.hits += 1
    conjugate = np.conj(spectrum) * hit.hit.impact.sign
    signs = np.array([float(c.dof.sign) for c in hit.channels])

    def add(start: int) -> None:
        rows = slice(start, min(start + BLOCK, signs.size))
        response = np.ascontiguousarray(transform(windows.responses(hit.responses[rows])))
        product = response * conjugate
        if (signs[rows] < 0).any():
            product *= signs[rows, None]
        sheet.cross[rows] += product
        if pairs is not None:
            for point, cross in zip(sheet.outputs[rows], product, strict=True):
                key = (point, sheet.impact)
                if key not in pairs:
                    pairs[key] = HitLines(strongest_lines(cross))
                pairs[key].add(hit.hit.label, cross, power)
        parts = response.view(np.float64)
        np.multiply(parts, parts, out=parts)
        sheet.auto[rows] += parts[:, 0::2]
        sheet.auto[rows] += parts[:, 1::2]

    list(pool.map(add, range(0, signs.size, BLOCK)))


def _finish(
    total: _Total, first: HitSamples, settings: FrfSettings, pool: ThreadPoolExecutor, with_coherence: bool
) -> FrfSet:
    """Sums to FRFs, in the sums' own memory where all hits share one sheet."""
    outputs, inputs = list(total.outputs), list(total.inputs)
    n_samples, rate = first.force.size, first.sample_rate_hz
    frequency = np.asarray(np.fft.rfftfreq(n_samples, 1 / rate), dtype=np.float64)
    shape = (len(outputs), len(inputs), frequency.size)
    hits = np.zeros(shape[:2], dtype=np.int64)
    release_memory()  # what spectra have taken, before the sums are put together
    forces = _forces(total, inputs)
    if len(total.sheets) == 1:
        _, sheet = total.sheets.popitem()
        cross, auto = sheet.cross[:, None, :], sheet.auto[:, None, :]
        hits[:] = sheet.hits
        force = {(0, 0): sheet.force}
        shared = True
    else:
        if with_coherence:  # to be stored, in the order of the axes
            cross, auto = np.zeros(shape, dtype=np.complex128), np.zeros(shape)
        else:  # each input by itself in memory: what is not yet written to takes none
            by_input = shape[1], shape[0], shape[2]
            cross = np.zeros(by_input, dtype=np.complex128).swapaxes(0, 1)
            auto = np.zeros(by_input).swapaxes(0, 1)
        force = {}
        shared = False
        while total.sheets:
            _, sheet = total.sheets.popitem()
            i = inputs.index(sheet.impact)
            for row, point in enumerate(sheet.outputs):
                o = outputs.index(point)
                cross[o, i] += sheet.cross[row]
                auto[o, i] += sheet.auto[row]
                hits[o, i] += sheet.hits
                # Outputs share the force sum of their sheet until a second sheet adds its own.
                force[o, i] = force[o, i] + sheet.force if (o, i) in force else sheet.force
            del sheet  # as large as its part of the FRFs
    variance = np.empty(shape) if with_coherence else auto

    def finish(output: int) -> None:
        for i in range(len(inputs)):
            key, sums = (0, 0) if shared else (output, i), auto[output, i]
            _finish_one(
                cross[output, i],
                sums,
                variance[output, i] if with_coherence else sums,
                force.get(key),
                int(hits[output, i]),
                settings,
            )

    list(pool.map(finish, range(len(outputs))))
    return FrfSet(
        frequency_hz=frequency,
        frf=cross,
        coherence=auto if with_coherence else unknown(shape),
        variance=variance,
        outputs=tuple(total.outputs.values()),
        inputs=tuple(total.inputs.values()),
        quantities=tuple(total.quantities[p] for p in outputs),
        hits=hits,
        estimator=settings.estimator,
        record_s=float(n_samples / rate),
        response_decay_rad_s=decay_rate(settings, n_samples / rate) + first.window_decay_rad_s,
        delay_s=np.array([float(np.mean(total.delays[p])) for p in inputs]),
        band_hz=_within(_band(forces, frequency, rate, settings.band_drop_db), first),
        force_calibrated=first.force_calibrated,
        sensor_mass_kg=np.array([total.masses[p] for p in outputs]),
        channels=tuple(total.channels[p] for p in outputs),
        hammer=total.hammer,
        variance_lines=np.array(
            [[_lines_of_variance(int(n), settings, frequency.size) for n in row] for row in hits],
            dtype=np.int64,
        ).reshape(hits.shape),
        rings_on=total.rings_on,
    )


def _finish_one(
    cross: NDArray[np.complex128],
    auto: NDArray[np.float64],
    variance: NDArray[np.float64],
    force: NDArray[np.float64] | None,
    n: int,
    settings: FrfSettings,
) -> None:
    """Turn, in place, the cross sum into the FRF and the auto sum into the coherence; fill the variance.

    Where the variance has the memory of the auto sum, there is no room for the coherence.
    """
    if force is None or n == 0:
        cross[:] = complex(np.nan, np.nan)
        auto[:] = variance[:] = np.nan
        return
    # A line without force, but for rounding, carries nothing; its FRF comes out as 0, not as NaN.
    inverse = np.divide(1.0, force, out=np.zeros_like(force), where=force > NOTHING * force.max())
    explained = (cross.real**2 + cross.imag**2) * inverse
    coherence = np.divide(explained, auto, out=np.zeros_like(auto), where=auto > 0).clip(max=1.0)
    if n > 1:
        noise = (auto - explained).clip(min=0.0)
        noise *= 1.0 / (n - 1)
        lines = _lines_of_variance(n, settings, noise.size)
        # Line 0 carries the sensors' offsets, which are no noise of its neighbours.
        noise[0] = noise[1]
        uniform_filter1d(noise, lines, output=noise, mode="nearest")
        np.multiply(noise, inverse, out=variance)
    else:
        variance[:] = np.nan
    cross *= inverse
    if settings.estimator != "H1":
        power = 1.0 if settings.estimator == "H2" else 0.5
        # H2 = H1/γ², Hv = H1/γ; a line without coherence has no H2: 0 there, as its H1 is.
        gain = np.divide(1.0, coherence**power, out=np.zeros_like(coherence), where=coherence > 1e-12)
        cross *= gain
        variance *= gain**2
    if variance is not auto:
        auto[:] = coherence if n > 1 else np.nan


def _lines_of_variance(n_hits: int, settings: FrfSettings, n_lines: int) -> int:
    """Neighbouring lines that give the noise power of some hits its degrees of freedom, an odd number."""
    if n_hits < 2:
        return 1
    return min(2 * (-(-settings.variance_dof // (n_hits - 1)) // 2) + 1, n_lines)


def _within(band_hz: tuple[float, float], hit: HitSamples) -> tuple[float, float]:
    """The band, no wider than the description states.

    Raises
    ------
    EmaError
        If the force carries nothing in the stated band.
    """
    low, high = max(band_hz[0], hit.band_hz[0]), min(band_hz[1], hit.band_hz[1])
    if not low < high:
        raise EmaError(
            f"{hit.hit.file}: band_hz = [{hit.band_hz[0]:g}, {hit.band_hz[1]:g}] is stated, but the force has "
            f"enough energy from {band_hz[0]:.4g} to {band_hz[1]:.4g} Hz only; correct band_hz or leave it out"
        )
    return low, high


def _forces(total: _Total, inputs: list[str]) -> list[NDArray[np.float64]]:
    """Force autospectrum of each input, summed over its sheets."""
    return [np.sum([s.force for s in total.sheets.values() if s.impact == point], axis=0) for point in inputs]


def _band(
    forces: list[NDArray[np.float64]], frequency: NDArray[np.float64], rate: float, drop_db: float
) -> tuple[float, float]:
    """Band in which the force of all but a tenth of the inputs carried enough energy.

    Enough is what stands `FLOOR_DB` above the hammer's own noise, for which the weakest part of all spectra
    is taken, but a drop of `SAFE_DROP_DB` is always enough and one of `drop_db` never. One weak blow among
    many must not narrow the band of all.
    """
    width = max(frequency.size // 256, 1)
    highest = rate * BAND_OVER_RATE
    # Line 0 is the offset. Medians over blocks are deaf to hum and drift lines.
    count = (frequency.size - 1) // width
    levels = [np.median(f[1 : 1 + count * width].reshape(count, width), axis=1) for f in forces]
    floor = min(float(np.min(level)) for level in levels) * 10 ** (FLOOR_DB / 10)
    tops = []
    for level in levels:
        top = int(np.argmax(level))
        least = np.clip(floor, level[top] * 10 ** (-drop_db / 10), level[top] * 10 ** (-SAFE_DROP_DB / 10))
        strong = level[top:] >= least
        share = np.cumsum(strong) / np.arange(1, strong.size + 1)
        # The zeros of a pulse's spectrum are narrow; beyond them the force is strong again.
        last = top + int(np.flatnonzero(strong & (share >= STRONG_SHARE))[-1])
        tops.append(float(frequency[min((last + 1) * width, frequency.size - 1)]))
    return float(frequency[1]), min(highest, float(np.quantile(tops, 0.1, method="lower")))
