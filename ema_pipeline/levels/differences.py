"""Small changes of the poles of single hits, in one window of lines, fitted to differences of FRFs.

See `single` for why differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import pole_functions, pole_values
from ema_pipeline.modal.noise import fit_noise

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

UNKNOWN = 0.3
"""A hit whose pole is not known to this share of the decay rate tells nothing of the mode: the differences are
only small ones in a hit that excites it."""

DEAF = 1e-300
"""Stands for the power of a line with hardly any force."""

SMOOTH_TERMS = 3
"""Polynomial in frequency per FRF that takes up how far modes differ from hit to hit."""

CURVED = 0.02
"""Change of a pole, in decay rates, above which the change is linearised anew."""

STEPS = 3

PLAIN = 2.0
"""Response of a mode over the largest misfit of a mean of hits, above which the mean tells its pole."""


@dataclass(frozen=True)
class Solved:
    """Per hit and mode: pole and participation, and the standard deviations of their parts; participation in the mean.

    Where a hit's pole is not known, its participation may be anything: at lines without force its FRFs are noise.
    """

    poles: Complex
    std: Real
    participation: Complex
    participation_std: Real
    mean_participation: Complex


def solve(
    omega: Real, frfs: list[Complex], power: Real, poles: Complex, shapes: Complex, rest_s: float
) -> Solved:
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
    smooth = smooth_terms(n_lines)
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
        unknown = np.full((1, m), np.inf)
        return Solved(poles[None], unknown, start[None], unknown, start)
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
    deviations = np.array(
        [_deviations(_whitened(columns, mean, scale * r, smooth)[0], own, common) for r in root]
    )
    std = deviations[:, :m]
    large = (std < -UNKNOWN * poles.real) & (np.abs(solution[:, :m]) > -CURVED * poles.real)
    for h in np.flatnonzero(large.any(axis=1)).tolist():
        better = _refined(
            omega, poles, shapes, rest_s, start, solution[h], difference[h], scale * root[h], smooth
        )
        both = np.tile(large[h], 2)  # what the hit hardly tells of may have gone astray
        solution[h, both] = better[both]
    return Solved(poles + solution[:, :m], std, start + solution[:, m:], deviations[:, m:], start)


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
    smooth, u = smooth_terms(len(omega)), pole_values(omega, poles, rest_s)
    u -= (u @ smooth.T) @ smooth
    # columns are shapes times functions of frequency, and all outputs count alike: so do their products
    gram = (shapes.conj() @ shapes.T) * (u.conj() @ u.T)
    return _solved(gram, np.sum(shapes.conj() * (u.conj() @ frf.T), axis=1))


def smooth_terms(n_lines: int) -> Real:
    """Orthonormal polynomials over the lines of a window, (n_terms, n_lines)."""
    return np.asarray(np.linalg.qr(np.vander(np.linspace(-1, 1, n_lines), SMOOTH_TERMS))[0].T)


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
    u = pole_values(omega, poles, rest_s)
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
    before = start[:, None] * pole_values(omega, poles, rest_s)
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
    return _solved(flat.conj() @ flat.T, flat.conj() @ data.ravel())


def _solved(gram: Complex, right: Complex) -> Complex:
    """Solution of normal equations, columns scaled to unit size."""
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
