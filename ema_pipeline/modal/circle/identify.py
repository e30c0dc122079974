"""Modes from circles alone: peaks of the mode indicator, then circle fits.

The oldest estimator of modal analysis and the easiest to look at. It takes one mode at a time, so modes
closer than about a bandwidth come out as one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, peak_widths

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.assurance import mpc
from ema_pipeline.modal.circle.compare import CLOSE_BANDWIDTHS, average
from ema_pipeline.modal.circle.fit import sweep
from ema_pipeline.modal.circle.modes import (
    Mobilities,
    Target,
    fit_targets,
    line_range,
    mobilities,
    to_circle_fit,
)
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.types import CircleFit, ModalModel, Mode, StabilisationChart
from ema_pipeline.threads import single_blas_thread

_ALTERNATIONS = 50
_NOISE_LINES = 51  # over which the noise of the indicator is taken
_VAGUE = 0.25  # a damping ratio less certain than this does not make a mode
_OVER_NOISE = 10.0  # a peak stands so much over it, in power


def identify_by_circle(frfs: FrfSet, settings: CircleSettings | None = None) -> ModalModel:
    """Identify modes by circle fits alone.

    Parameters
    ----------
    frfs : FrfSet
    settings : CircleSettings, optional

    Returns
    -------
    ModalModel
        Modes with method ``"circle"``: frequency and damping are medians over the best FRFs, shapes come from
        the circle diameters of all FRFs at that frequency and damping. The chart is empty.

    Raises
    ------
    EmaError
        If no FRF was measured, or none shows a resonance within the band.
    """
    with single_blas_thread():
        return _identify(frfs, settings or CircleSettings())


def _identify(frfs: FrfSet, settings: CircleSettings) -> ModalModel:
    data = mobilities(frfs)
    if data.output.size == 0:
        raise EmaError("circle fit: no measured FRF; check impacts and channels in test.toml")
    targets = find_peak_targets(data, frfs.band_hz, settings)
    kept: list[tuple[Target, list[CircleFit]]] = []
    # first by themselves, to find their widths; then with those, and the neighbours taken off if so set
    for pass_ in (settings.model_copy(update={"remove_neighbours": False}), settings):
        kept = []
        for target, found in zip(targets, fit_targets(data, targets, pass_), strict=True):
            circles = [
                (row, c)
                for row, c in found
                if c.residual < settings.maximum_residual
                and c.damping_ratio < settings.maximum_damping_ratio
                and c.damping_std < _VAGUE * c.damping_ratio
                and c.frequency_hz[0] < c.natural_frequency_hz < c.frequency_hz[-1]
            ]
            if 2 * len(circles) <= len(found):
                continue
            middle = Target(
                float(np.median([c.natural_frequency_hz for _, c in circles])),
                float(np.median([c.damping_ratio for _, c in circles])),
            )
            if any(abs(middle.frequency_hz - t.frequency_hz) < 0.5 * t.half_width_hz for t, _ in kept):
                continue  # two peaks led to one resonance
            if not target.frequency_hz / 1.05 < middle.frequency_hz < target.frequency_hz * 1.05:
                continue
            kept.append((middle, [to_circle_fit(c, frfs, data, row) for row, c in circles]))
        targets = sorted((t for t, _ in kept), key=lambda t: t.frequency_hz)
    if not kept:
        raise EmaError(
            f"circle fit: no resonance between {frfs.band_hz[0]:.4g} and {frfs.band_hz[1]:.4g} Hz; "
            "check the FRFs, or lower peak_prominence_db"
        )
    kept.sort(key=lambda pair: pair[0].frequency_hz)
    return _assemble(frfs, data, kept, settings)


def find_peak_targets(
    data: Mobilities, band_hz: tuple[float, float], settings: CircleSettings
) -> list[Target]:
    """Peaks of the sum of |mobility|² over all FRFs, each over its own mean in the band."""
    inside = _inside(data, band_hz)
    f = data.frequency_hz[inside]
    mobility = data.mobility(inside)
    mobility = mobility[np.median(np.abs(mobility), axis=1) > 0]
    power = np.abs(mobility) ** 2
    if f.size < 2 * settings.minimum_points or power.size == 0:
        return []
    # by the median, not the mean: else one strong mode would hide the others of its FRF
    usual = np.median(power, axis=1, keepdims=True)
    indicator = np.sum(power / usual, axis=0)
    # what changes from line to line is noise: the resonances are smooth over most lines
    rough = np.abs(np.diff(mobility, n=2, axis=1)) ** 2 / 6
    floor = median_filter(np.pad(np.sum(rough / usual, axis=0), 1, mode="edge"), size=_NOISE_LINES)
    level = 10 * np.log10(np.maximum(indicator, indicator.max() * 1e-30))
    peaks, _ = find_peaks(level, prominence=settings.peak_prominence_db)
    peaks = peaks[indicator[peaks] > _OVER_NOISE * floor[peaks]]
    spacing = f[1] - f[0]
    widths = peak_widths(indicator, peaks, rel_height=0.5)[0] * spacing if peaks.size else []
    return [
        Target(float(f[k]), float(np.clip(width / (2 * f[k]), 1e-5, settings.maximum_damping_ratio)))
        for k, width in zip(peaks, widths, strict=True)
    ]


def _inside(data: Mobilities, band_hz: tuple[float, float]) -> slice:
    """Lines of a band."""
    low = int(np.searchsorted(data.frequency_hz, band_hz[0]))
    return slice(low, int(np.searchsorted(data.frequency_hz, band_hz[1], side="right")))


def rank_one(matrix: NDArray[np.complex128]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Vectors a, (n,), and b, (m,), whose a bᵀ is closest to a matrix that may have gaps (NaN).

    Alternating least squares; entries of rows or columns without any value are NaN.
    """
    has = np.isfinite(matrix)
    filled = np.where(has, matrix, 0.0)
    u, s, vh = np.linalg.svd(filled, full_matrices=False)
    a, b = u[:, 0] * np.sqrt(s[0]), vh[0] * np.sqrt(s[0])
    for _ in range(1 if np.all(has) else _ALTERNATIONS):
        a = _divide(filled @ b.conj(), has @ np.abs(b) ** 2)
        b = _divide(filled.T @ a.conj(), has.T @ np.abs(a) ** 2)
    return np.where(has.any(axis=1), a, np.nan), np.where(has.any(axis=0), b, np.nan)


def _assemble(
    frfs: FrfSet,
    data: Mobilities,
    kept: list[tuple[Target, list[CircleFit]]],
    settings: CircleSettings,
) -> ModalModel:
    targets = [target for target, _ in kept]
    outputs, inputs = frfs.outputs, frfs.inputs
    driving = [(o, i) for o, out in enumerate(outputs) for i, in_ in enumerate(inputs) if out == in_]
    measured = np.zeros((len(outputs), len(inputs)), dtype=bool)
    measured[data.output, data.input] = True
    driving = [(o, i) for o, i in driving if measured[o, i]]
    scaled = bool(driving) and frfs.force_calibrated
    dofs = outputs + tuple(i for i in inputs if i not in outputs) if driving else outputs
    if not driving and len(inputs) > len(outputs):
        dofs = inputs  # a roving hammer
    f = data.frequency_hz[_inside(data, frfs.band_hz)]
    total = np.zeros((data.output.size, f.size), dtype=complex)
    modes = []
    for index, (target, circles) in enumerate(kept):
        lines = line_range(data.frequency_hz, targets, index, settings)
        constants, stds = _modal_constants(data, target, lines)
        total += constants[:, None] * _term(f, target)
        matrix = np.full(measured.shape, np.nan, dtype=complex)
        noise = np.full(measured.shape, np.nan)
        matrix[data.output, data.input] = constants
        noise[data.output, data.input] = stds
        shape, shape_std = _shape(matrix, noise, dofs, outputs, inputs, driving, scaled)
        middle = average(circles)
        w = 2 * np.pi * middle.frequency_hz
        zeta = middle.damping_ratio
        modes.append(
            Mode(
                frequency_hz=middle.frequency_hz,
                frequency_std_hz=middle.frequency_std_hz,
                damping_ratio=zeta,
                damping_std=middle.damping_std,
                pole=complex(-zeta * w, w * np.sqrt(max(1 - zeta**2, 0.0))),
                shape=shape,
                shape_std=shape_std,
                mpc=mpc(shape),
                method="circle",
                circles=tuple(circles),
                flags=_remarks(targets, index),
            )
        )
    synthesis = np.full((*measured.shape, f.size), np.nan, dtype=np.complex64)
    synthesis[data.output, data.input] = total * 2j * np.pi * f
    note = "" if scaled else "no driving point" if frfs.force_calibrated else "the hammer is not calibrated"
    none = np.empty(0)
    return ModalModel(
        dofs=dofs,
        modes=tuple(modes),
        band_hz=frfs.band_hz,
        scaled=scaled,
        scaling_note=note,
        references=inputs if dofs is not inputs else outputs,
        frequency_hz=f,
        synthesis=synthesis,
        outputs=outputs,
        inputs=inputs,
        chart=StabilisationChart(
            none.astype(np.int64), none, none, none.astype(np.bool_), none.astype(np.int64)
        ),
        notes=("circle fits take one mode at a time: modes closer than about a bandwidth come out as one",),
    )


def _term(frequency_hz: NDArray[np.float64], target: Target) -> NDArray[np.complex128]:
    """Mobility jω/(ω_n² - ω² + 2jζω_nω) of a mode with modal constant 1."""
    w_n = 2 * np.pi * target.frequency_hz
    x = sweep(frequency_hz, target.frequency_hz, target.damping_ratio)
    return np.asarray(1 / (2 * target.damping_ratio * w_n * (1 + 1j * x)), dtype=np.complex128)


def _modal_constants(
    data: Mobilities, target: Target, lines: slice
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """φ_o·φ_i of every FRF from its circle's diameter at given frequency and damping; std per real part."""
    term = _term(data.frequency_hz[lines], target)
    columns = np.stack([np.ones_like(term), term / np.abs(term).max()], axis=1)
    values = data.mobility(lines).T
    solution, *_ = np.linalg.lstsq(columns, values, rcond=None)
    misfit = values - columns @ solution
    noise = np.sum(np.abs(misfit) ** 2, axis=0) / max(2 * (term.size - 2), 1)
    inverse = np.linalg.inv(columns.conj().T @ columns)
    scale = np.abs(term).max()
    return solution[1] / scale, np.sqrt(noise * inverse[1, 1].real) / scale


def _shape(
    constants: NDArray[np.complex128],
    stds: NDArray[np.float64],
    dofs: tuple[Dof, ...],
    outputs: tuple[Dof, ...],
    inputs: tuple[Dof, ...],
    driving: list[tuple[int, int]],
    scaled: bool,
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Shape at `dofs`: φ_o from the columns, φ_i from the rows, scaled to each other at driving points."""
    a, b = rank_one(constants)
    if driving:
        at_a, at_b = np.array([a[o] for o, _ in driving]), np.array([b[i] for _, i in driving])
        # φ = q·a at the outputs and b/q at the inputs, alike at the driving points
        ratio = np.sum(at_a.conj() * at_b) / max(float(np.sum(np.abs(at_a) ** 2)), 1e-300)
        q = np.sqrt(complex(ratio)) if ratio != 0 else 1.0 + 0j
        a, b = a * q, b / q
    values = dict(zip(inputs, b, strict=True)) if driving or dofs is inputs else {}
    if dofs is not inputs:
        values |= dict(zip(outputs, a, strict=True))
    shape = np.array([values[d] for d in dofs], dtype=np.complex128)
    # the error of an entry comes from the FRF with the reference that sees the mode best
    by_output = _entry_std(stds, b)
    by_input = _entry_std(stds.T, a)
    errors = dict(zip(inputs, by_input, strict=True))
    if dofs is not inputs:
        errors |= dict(zip(outputs, by_output, strict=True))
    shape_std = np.array([errors[d] for d in dofs])
    largest = shape[np.nanargmax(np.abs(shape))]
    if scaled:
        return (shape if largest.real >= 0 else -shape), shape_std
    return shape / largest, shape_std / abs(largest)


def _entry_std(stds: NDArray[np.float64], weight: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Standard deviation of the entries of a, (n,), in a bᵀ, from that of the products, (n, m)."""
    information = np.where(np.isfinite(stds) & (stds > 0), np.abs(weight) ** 2 / stds**2, 0.0)
    total = np.nansum(information, axis=1)
    return np.sqrt(np.divide(1.0, total, out=np.full(total.shape, np.nan), where=total > 0))


def _remarks(targets: list[Target], index: int) -> tuple[str, ...]:
    own = targets[index]
    near = [
        t.frequency_hz
        for k, t in enumerate(targets)
        if k != index
        and abs(t.frequency_hz - own.frequency_hz)
        < 2 * CLOSE_BANDWIDTHS * max(own.half_width_hz, t.half_width_hz)
    ]
    return tuple(f"close neighbour at {f:.5g} Hz" for f in near)


def _divide(top: NDArray[np.complex128], bottom: NDArray[np.float64]) -> NDArray[np.complex128]:
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0)
