"""Poles of every single hit, as small differences from what all hits of its point show together.

What a fit of modes to FRFs leaves over (far modes, leakage, small errors of the shapes) is the same in every hit
of a point. So not the FRFs themselves are fitted, but the difference of each hit's FRFs from the mean over its
point's hits, with the derivatives of the modes by their poles and participations. Whatever is systematic
cancels, and what is left over is noise, whose size it tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import uniform_filter1d

from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.frf.windows import Windows
from ema_pipeline.ingest.records import HitSamples
from ema_pipeline.modal.basis import pole_functions
from ema_pipeline.modal.noise import fit_noise
from ema_pipeline.modal.types import ModalModel

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Hits = Callable[[], Iterable[HitSamples]]

REACH = 8.0
"""Half-power half-widths on either side of a mode that tell its pole."""

FEWEST_LINES = 12
"""Lines on either side at least."""

SMOOTH_TERMS = 3
"""Polynomial in frequency per FRF that takes up how far modes differ from hit to hit."""

UNKNOWN = 0.3
"""A hit whose pole is not known to this share of the decay rate tells nothing of the mode: the differences are
only small ones in a hit that excites it."""


CURVED = 0.02
"""Change of a pole, in decay rates, above which the change is linearised anew."""

STEPS = 3

PLAIN = 2.0
"""Response of a mode over the largest misfit of a mean of hits, above which the mean tells its pole."""

CLEAR_FORCE = 100.0
"""Force power over the hammer's noise, below which the FRF of a single hit is biased."""


DEAF = 1e-300
"""Stands for the power of a line with hardly any force."""

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
    amplitude_m : ndarray, (n_hits, n_modes)
        Largest displacement amplitude at any sensor just after the hit; NaN for an uncalibrated hammer.
    """

    names: tuple[str, ...]
    point: NDArray[np.int64]
    sheet: NDArray[np.int64]
    force_n: Real
    frequency_hz: Real
    frequency_std_hz: Real
    damping_ratio: Real
    damping_std: Real
    amplitude_m: Real


@dataclass(frozen=True)
class Window:
    """Lines and the modes among them: `lines` of the FRFs' axis, `modes` as indices."""

    lines: slice
    modes: NDArray[np.int64]


@dataclass(frozen=True)
class _Hit:
    """What is kept of one hit: accelerance and power of the force in each window; at each mode, the force and
    whether it is clear of the hammer's noise.
    """

    name: str
    force_n: float
    rest_s: float
    frf: tuple[Complex, ...]
    power: tuple[Real, ...]
    impulse: Complex
    heard: NDArray[np.bool_]
    calibrated: bool


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
    count = 0
    for hit in hits():
        one = estimate_frfs([hit], frf_settings)
        key = (one.inputs[0].point, tuple(d.point for d in one.outputs))
        sheets.setdefault(key, []).append((count, _spectra(hit, one, windows, frequency, frf_settings)))
        count += 1
    shape = (count, len(poles))
    names, force = [""] * count, np.zeros(count)
    point, sheet = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    pole, std = np.tile(poles, (count, 1)), np.full(shape, np.inf)
    amplitude = np.full(shape, np.nan)
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
            solved = _solve(omega, [h.frf[k] for h in members], np.array([h.power[k] for h in members]),
                            poles[m], seen[m], float(np.mean([h.rest_s for h in members])))  # fmt: skip
            pole[np.ix_(index, m)] = solved.poles
            known = solved.std < -UNKNOWN * poles[m].real
            known &= np.array([h.heard[m] for h in members])
            std[np.ix_(index, m)] = np.where(known, solved.std, np.inf)
            if members[0].calibrated:
                impulse = np.array([np.abs(h.impulse[m]) for h in members])
                largest = np.abs(seen[m]).max(axis=1)
                amplitude[np.ix_(index, m)] = (
                    2 * np.abs(solved.participation) * largest * impulse / np.abs(poles[m]) ** 2
                )
    physical = pole + decay
    return HitPoles(
        tuple(names), point, sheet, force,
        np.abs(physical) / (2 * np.pi), std / (2 * np.pi),
        -physical.real / np.abs(physical), std / np.abs(physical), amplitude,
    )  # fmt: skip


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


def participations(omega: Real, frf: Complex, poles: Complex, shapes: Complex, rest_s: float) -> Complex:
    """Participation of each mode of a window in FRFs of one impact point, the shapes given.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
        rad/s.
    frf : complex ndarray, (n_outputs, n_lines)
        Accelerance.
    poles : complex ndarray, (n_modes,)
    shapes : complex ndarray, (n_modes, n_outputs)
    rest_s : float
        Time from the hit to the end of the record.

    Returns
    -------
    complex ndarray, (n_modes,)
        Residue over shape.
    """
    u, _ = pole_functions(omega, poles, rest_s)
    weight = np.ones((len(frf), len(omega)))
    return _least_squares(*_whitened(shapes.T[:, :, None] * u, frf, weight, _smooth(len(omega))))


def _smooth(n_lines: int) -> Real:
    """Orthonormal polynomials over the lines of a window, (n_terms, n_lines)."""
    return np.asarray(np.linalg.qr(np.vander(np.linspace(-1, 1, n_lines), SMOOTH_TERMS))[0].T)


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
    return _Hit(
        f"{hit.hit.file}#{hit.hit.number}",
        abs(hit.hit.peak_force),
        max(one.record_s - float(one.delay_s[0]), 0.5 * one.record_s),
        tuple(acc[:, w.lines].copy() for w in windows),
        tuple(power[w.lines] for w in windows),
        force[line],
        heard,
        hit.force_calibrated,
    )


@dataclass(frozen=True)
class _Solved:
    """Per hit and mode: pole, standard deviation of its parts, participation."""

    poles: Complex
    std: Real
    participation: Complex


def _solve(
    omega: Real, frfs: list[Complex], power: Real, poles: Complex, shapes: Complex, rest_s: float
) -> _Solved:
    """Differences of every hit's poles from the mean of its sheet, in one window.

    Parameters
    ----------
    omega : ndarray, (n_lines,)
    frfs : list of complex ndarray, (n_outputs, n_lines)
        Accelerance of each hit.
    power : ndarray, (n_hits, n_lines)
        Force power of each hit: its noise is inverse to it.
    poles : complex ndarray, (n_modes,)
    shapes : complex ndarray, (n_modes, n_outputs)
    rest_s : float
    """
    data = np.array(frfs)
    n_hits, n_out, n_lines = data.shape
    m = len(poles)
    total = power.sum(axis=0)
    mean = np.einsum("hl,hol->ol", power / total, data)
    smooth = _smooth(n_lines)
    u, du = pole_functions(omega, poles, rest_s)
    difference = data - mean
    level = np.median(np.abs(difference) ** 2 * power[:, None], axis=(0, 2))
    level = np.maximum(level, 1e-24 * np.max(np.abs(mean) ** 2 * total) / n_hits)
    scale = np.broadcast_to(1 / np.sqrt(level[:, None]), (n_out, n_lines))  # for unit force power
    root = np.sqrt(power)[:, None]

    along = shapes.T[:, :, None] * u  # (n_outputs, n_modes, n_lines)
    start = _least_squares(*_whitened(along, mean, scale * np.sqrt(total), smooth))
    columns = np.concatenate([shapes.T[:, :, None] * start[:, None] * du, along], axis=1)
    if n_hits == 1:
        return _Solved(poles[None], np.full((1, m), np.inf), start[None])
    moved = _of_mean(omega, poles, shapes, rest_s, start, mean, scale * np.sqrt(total), smooth)
    if np.any(np.abs(moved - poles) > -CURVED * poles.real):
        poles = moved
        u, du = pole_functions(omega, poles, rest_s)
        along = shapes.T[:, :, None] * u
        start = _least_squares(*_whitened(along, mean, scale * np.sqrt(total), smooth))
        columns = np.concatenate([shapes.T[:, :, None] * start[:, None] * du, along], axis=1)
    # a line that only one hit heard tells nothing of its noise
    heard = np.count_nonzero(power > DEAF, axis=0)
    free = max(1.0 - (2 * m / n_out + SMOOTH_TERMS) / n_lines, 0.2) * np.maximum(heard - 1, 1)
    for _ in range(2):
        solution = np.empty((n_hits, 2 * m), dtype=np.complex128)
        left_power = np.zeros((n_out, n_lines))
        for h in range(n_hits):
            white, rest = _whitened(columns, difference[h], scale * root[h], smooth)
            solution[h] = _least_squares(white, rest)
            left_power += np.abs(rest - np.einsum("c,ocl->ol", solution[h], white)) ** 2
        left_power = np.where(heard > 1, left_power / scale**2 / free, np.nan)
        model = fit_noise(
            left_power[:, None], mean[:, None], np.ones((n_out, 1), dtype=bool), inputs_are_rows=False
        )
        scale = 1 / np.sqrt(model.variance[:, 0])
    own = model.own[:, 0] * scale**2
    common = np.sqrt(model.common[:, 0]) * scale * mean / np.maximum(np.abs(mean), 1e-300)
    std = np.array(
        [_deviations(_whitened(columns, mean, scale * r, smooth)[0], own, common)[:m] for r in root]
    )
    large = (std < -UNKNOWN * poles.real) & (np.abs(solution[:, :m]) > -CURVED * poles.real)
    for h in np.flatnonzero(large.any(axis=1)).tolist():
        better = _refined(
            omega, poles, shapes, rest_s, start, solution[h], difference[h], scale * root[h], smooth
        )
        both = np.tile(large[h], 2)  # what the hit hardly tells of may have gone astray
        solution[h, both] = better[both]
    return _Solved(poles + solution[:, :m], std, start + solution[:, m:])


def _of_mean(
    omega: Real,
    poles: Complex,
    shapes: Complex,
    rest_s: float,
    start: Complex,
    mean: Complex,
    weight: Real,
    smooth: Real,
) -> Complex:
    """Poles of the mean over a sheet's hits, where the given ones are those of other hits.

    Differences from the mean are linearised about its own poles, or their curvature would pass for a change. Modes
    that the mean hardly tells of keep theirs.
    """
    m = len(poles)
    u, _ = pole_functions(omega, poles, rest_s)
    left = mean - shapes.T @ (start[:, None] * u)
    change = _refined(omega, poles, shapes, rest_s, start, np.zeros(2 * m, complex), left, weight, smooth)[:m]
    strong = np.max(np.abs(start[:, None] * u), axis=1) > PLAIN * np.max(np.abs(left))
    return np.where(strong & (np.abs(change) < -UNKNOWN * poles.real), poles + change, poles)


def _refined(
    omega: Real,
    poles: Complex,
    shapes: Complex,
    rest_s: float,
    start: Complex,
    change: Complex,
    difference: Complex,
    weight: Real,
    smooth: Real,
) -> Complex:
    """Change of poles and participations of one hit, linearised anew where the last step ended."""
    m = len(poles)
    before = start[:, None] * pole_functions(omega, poles, rest_s)[0]
    for _ in range(STEPS):
        now = start + change[m:]
        u, du = pole_functions(omega, poles + change[:m], rest_s)
        left = difference - shapes.T @ (now[:, None] * u - before)
        columns = np.concatenate(
            [shapes.T[:, :, None] * (now[:, None] * du), shapes.T[:, :, None] * u], axis=1
        )
        step = _least_squares(*_whitened(columns, left, weight, smooth))
        if np.any(np.abs(step[:m]) > -poles.real):
            break
        change = change + step
    return change


def _whitened(columns: Complex, data: Complex, weight: Real, smooth: Real) -> tuple[Complex, Complex]:
    """Columns and data at unit noise, without the polynomial that far modes make.

    Parameters
    ----------
    columns : complex ndarray, (n_outputs, n_columns, n_lines)
    data : complex ndarray, (n_outputs, n_lines)
    weight : ndarray, (n_outputs, n_lines)
        One over the standard deviation of the noise.
    smooth : ndarray, (n_terms, n_lines)
    """
    basis = np.linalg.qr((smooth * weight[:, None] / weight.max(axis=1)[:, None, None]).swapaxes(1, 2))[0]
    white, rest = columns * weight[:, None], data * weight
    white = white - np.matmul(np.matmul(white, basis), basis.swapaxes(1, 2))
    rest = rest - np.matmul(np.matmul(rest[:, None], basis), basis.swapaxes(1, 2))[:, 0]
    return white, rest


def _least_squares(columns: Complex, data: Complex) -> Complex:
    """Coefficients of columns (n_outputs, n_columns, n_lines) in data (n_outputs, n_lines)."""
    flat = columns.swapaxes(0, 1).reshape(columns.shape[1], -1)
    gram, right = flat.conj() @ flat.T, flat.conj() @ data.ravel()
    size = 1 / np.sqrt(np.maximum(gram.diagonal().real, 1e-300))
    return np.asarray(size * np.linalg.lstsq(gram * size[:, None] * size, size * right, rcond=1e-10)[0])


def _deviations(white: Complex, own: Real, common: Complex) -> Real:
    """Standard deviations of the coefficients' parts, noise that all outputs have in common included.

    Parameters
    ----------
    white : complex ndarray, (n_outputs, n_columns, n_lines)
        Columns at unit noise.
    own : ndarray, (n_outputs, n_lines)
        Share of the noise's variance that is the output's own.
    common : complex ndarray, (n_outputs, n_lines)
        Amplitude of the noise that all outputs have in common.
    """
    flat = white.swapaxes(0, 1).reshape(white.shape[1], -1)
    gram = flat.conj() @ flat.T
    size = 1 / np.sqrt(np.maximum(gram.diagonal().real, 1e-300))
    inverse = size[:, None] * np.linalg.pinv(gram * size[:, None] * size, rcond=1e-12, hermitian=True) * size
    estimator = np.einsum("cd,odl->col", inverse, white.conj(), optimize=True)
    together = np.einsum("col,ol->cl", estimator, common)
    variance = np.einsum("col,ol->c", np.abs(estimator) ** 2, own) + np.sum(np.abs(together) ** 2, axis=1)
    return np.asarray(np.sqrt(variance / 2))
