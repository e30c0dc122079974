"""From a recorded sine test to one averaged loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.fourier import fourier, fourier_slope

FEWEST_SAMPLES = 32
"""Samples per cycle below which a loop has no shape."""
_SIGNIFICANT = 5.0
_NOT_PERIODIC = 0.3
_LEAST_NOISE = 1e-6
_CYCLES = 3


def measure_loop(
    displacement: NDArray[np.float64],
    force: NDArray[np.float64],
    sample_rate_hz: float,
    frequency_hz: float,
    amplitude_m: float | None = None,
    *,
    name: str = "loop",
    settings: LoopSettings | None = None,
) -> Loop:
    """Average the steady cycles of a sine test.

    Parameters
    ----------
    displacement, force : ndarray, (n_samples,)
        m, N.
    sample_rate_hz, frequency_hz : float
        The frequency as set; the true one is sought nearby.
    amplitude_m : float, optional
        The amplitude as set, which the measured one is held against.
    name : str
        Named in error messages.
    settings : LoopSettings, optional

    Returns
    -------
    Loop

    Raises
    ------
    EmaError
        For too few samples per cycle, no steady cycle, a stated amplitude or frequency that is not there.

    Notes
    -----
    Run-up and run-down are left out. The displacement is a Fourier series fitted to all samples, which takes
    out its noise: each small reversal of a noisy displacement would otherwise start a small loop in the
    model. The force is averaged in bins of phase.
    """
    s = settings or LoopSettings()
    x, f = np.asarray(displacement, dtype=float), np.asarray(force, dtype=float)
    per_cycle = sample_rate_hz / frequency_hz
    if per_cycle < FEWEST_SAMPLES:
        raise EmaError(
            f"{name}: {per_cycle:.3g} samples per cycle at {frequency_hz:g} Hz; a loop needs "
            f"{FEWEST_SAMPLES} or more: raise sample_rate_hz"
        )
    if np.ptp(f) == 0:
        raise EmaError(f"{name}: the force does not change; check the channel")
    start, stop = _steady(x, round(per_cycle), s.steady_tolerance, name)
    x, f = x[start:stop], f[start:stop]
    true_hz = _refine(x, sample_rate_hz, frequency_hz, s.frequency_search)
    cycles = int(len(x) * true_hz / sample_rate_hz + 0.02)
    keep = min(len(x), round(cycles * sample_rate_hz / true_hz))
    x, f = x[:keep], f[:keep]
    phase = np.asarray(true_hz * np.arange(keep) / sample_rate_hz, dtype=np.float64)

    count = int(min(s.points_per_cycle, per_cycle))
    series, coefficient_std = _series(phase, x, min(s.displacement_harmonics, count // 4))
    harmonics = len(series) // 2
    left = float(np.std(x - fourier(phase, harmonics) @ series)) / float(np.std(x))
    if left > _NOT_PERIODIC:
        raise EmaError(
            f"{name}: the displacement does not repeat at {frequency_hz:g} Hz ({100 * left:.0f} % of it is "
            "left over); correct frequency_hz or sample_rate_hz"
        )
    index = (phase * count).astype(int) % count
    number = np.bincount(index, minlength=count)
    filled = number > 0
    number = number[filled]
    inside = np.bincount(index, weights=phase * count % 1.0, minlength=count)[filled] / number
    at = (np.flatnonzero(filled) + inside) / count
    mean_force = np.bincount(index, weights=f, minlength=count)[filled] / number
    smooth = fourier(np.linspace(0, 1, 4 * count), harmonics) @ series
    low, high = float(smooth.min()), float(smooth.max())
    amplitude = 0.5 * (high - low)
    if amplitude_m is not None and abs(amplitude / amplitude_m - 1) > s.amplitude_tolerance:
        raise EmaError(
            f"{name}: the displacement's amplitude is {1e3 * amplitude:.4g} mm, amplitude_m says "
            f"{1e3 * amplitude_m:.4g} mm; correct amplitude_m, or the channel's unit or sensitivity"
        )
    series[0] -= 0.5 * (low + high)
    velocity = fourier_slope(at, harmonics) @ series * true_hz
    between = f - np.interp(phase % 1.0, at, mean_force, period=1.0)
    noise = max(_noise(f), _cycle_scatter(between, index, phase, count), _LEAST_NOISE * float(np.ptp(f)))
    each = _energies(phase, f, harmonics, series, cycles)
    scatter = float(np.std(each, ddof=1) / np.sqrt(cycles)) if cycles > 1 else 0.0
    own = noise * float(np.sqrt(np.mean(velocity**2))) / (true_hz * np.sqrt(keep))
    return Loop(
        name=name,
        frequency_hz=float(true_hz),
        amplitude_m=float(amplitude),
        phase=at,
        series=series,
        displacement=fourier(at, harmonics) @ series,
        velocity=velocity,
        force=mean_force,
        force_std_n=float(noise * np.sqrt(count / keep)),
        cycles=cycles,
        energy_j=float(np.mean(each)),
        energy_std_j=float(max(scatter, own)),
        displacement_std_m=coefficient_std,
    )


def share_noise(loops: Sequence[Loop]) -> tuple[Loop, ...]:
    """Loops of too few cycles to know their scatter take that of the others, as a share of the force.

    Otherwise a loop of a single cycle would count as the most certain of all.
    """
    known = [
        one.force_std_n / float(np.ptp(one.force)) * np.sqrt(one.cycles)
        for one in loops
        if one.cycles >= _CYCLES
    ]
    if not known:
        return tuple(loops)
    share = float(np.median(known))

    def least(one: Loop) -> float:
        return share * float(np.ptp(one.force)) / float(np.sqrt(one.cycles))

    return tuple(
        one if one.cycles >= _CYCLES else replace(one, force_std_n=max(one.force_std_n, least(one)))
        for one in loops
    )


def _steady(x: NDArray[np.float64], period: int, tolerance: float, name: str) -> tuple[int, int]:
    """First and last sample of the longest run of cycles at full amplitude."""
    step = max(1, period // 8)
    starts = np.arange(0, len(x) - period + 1, step)
    if len(starts) == 0:
        raise EmaError(f"{name}: shorter than one cycle; record several cycles at full amplitude")
    ranges = np.array([np.ptp(x[i : i + period]) for i in starts])
    full = float(np.quantile(ranges, 0.95)) if np.ptp(ranges) < 0.2 * ranges.max() else float(ranges.max())
    if full <= 0:
        raise EmaError(f"{name}: the displacement does not move; check the channel")
    steady = np.abs(ranges / full - 1) <= tolerance
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(starts[first]), int(min(starts[last - 1] + period, len(x)))


def _refine(x: NDArray[np.float64], rate: float, frequency_hz: float, search: float) -> float:
    """Frequency at which three harmonics leave the least of the displacement.

    Sought within what the record's length can tell, at most `search`.
    """
    cycles = len(x) * frequency_hz / rate
    width = min(search, 0.5 / cycles) * frequency_hz
    if width == 0.0:
        return frequency_hz
    time = np.arange(len(x)) / rate

    def left(f: float) -> float:
        basis = fourier(f * time, 3)
        return float(np.sum((x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0]) ** 2))

    bounds = (frequency_hz - width, frequency_hz + width)
    found = scipy.optimize.minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return float(found.x)


def _series(
    phase: NDArray[np.float64], x: NDArray[np.float64], most: int
) -> tuple[NDArray[np.float64], float]:
    """Fourier coefficients of x up to the highest harmonic that stands out of the noise, and their std."""
    series = np.linalg.lstsq(fourier(phase, most), x, rcond=None)[0]
    left = float(np.std(x - fourier(phase, most) @ series))
    std = left * float(np.sqrt(2.0 / len(x)))
    size = np.hypot(series[1 : most + 1], series[most + 1 :])
    kept = int(np.max(np.flatnonzero(size > _SIGNIFICANT * std), initial=0)) + 1
    final = np.linalg.lstsq(fourier(phase, kept), x, rcond=None)[0]
    return np.asarray(final, dtype=np.float64), std


def _noise(force: NDArray[np.float64]) -> float:
    """Standard deviation of white noise from second differences, which a smooth signal hardly has."""
    second = force[:-2] - 2 * force[1:-1] + force[2:]
    return float(np.sqrt(np.mean(second**2) / 6.0))


def _cycle_scatter(
    left: NDArray[np.float64], index: NDArray[np.intp], phase: NDArray[np.float64], count: int
) -> float:
    """Standard deviation of a sample as the scatter between cycles tells it; 0 for fewer than three cycles.

    Larger than that of neighbouring samples where the cycles themselves differ.
    """
    cycles = int(phase[-1]) + 1
    cell = index + count * phase.astype(int)
    number = np.bincount(cell, minlength=count * cycles).reshape(cycles, count)
    if cycles < _CYCLES or np.any(number.sum(axis=0) == 0):
        return 0.0
    total = np.bincount(cell, left, count * cycles).reshape(cycles, count)
    mean = total / np.maximum(number, 1)
    kept = np.all(number > 0, axis=0)
    if not kept.any():
        return 0.0
    variance = np.var(mean[:, kept], axis=0, ddof=1) * (1 / np.mean(1 / number[:, kept], axis=0))
    return float(np.sqrt(np.mean(variance)))


def _energies(
    phase: NDArray[np.float64],
    force: NDArray[np.float64],
    harmonics: int,
    series: NDArray[np.float64],
    cycles: int,
) -> NDArray[np.float64]:
    """Energy of each cycle, J, (cycles,)."""
    power = force * (fourier_slope(phase, harmonics) @ series)
    cycle = np.minimum(phase.astype(int), cycles - 1)
    return np.asarray(np.bincount(cycle, power, cycles) / np.bincount(cycle, minlength=cycles))
