"""FRFs in, modes out: the whole of modal identification in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.assurance import mpc
from ema_pipeline.modal.band_end import seen_band
from ema_pipeline.modal.bands import SubBand, between, indicator, split
from ema_pipeline.modal.compress import Window
from ema_pipeline.modal.data import FEW_AT_ONCE, FitData, analysis_band, arrange
from ema_pipeline.modal.drift.plain import plain_peaks
from ema_pipeline.modal.engines import poles_of_all_orders
from ema_pipeline.modal.fit import (
    Estimate,
    residual_fit,
    synthesis,
)
from ema_pipeline.modal.fitted_modes import FittedModes
from ema_pipeline.modal.left_out import left_out, sentences
from ema_pipeline.modal.noise import Noise, fit_law, flat_law, second_difference_power
from ema_pipeline.modal.peaks import NO_PEAKS, KnownPeaks, seeded
from ema_pipeline.modal.pole_tracks import link, votes
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.scaling import scale_shapes, scaling_note
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.sub_bands import candidates, first_guess, refined, tracked, whole
from ema_pipeline.modal.turns import spread_of_turns
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart
from ema_pipeline.processes import release_memory
from ema_pipeline.threads import in_order, single_blas_thread

Progress = Callable[[float, str], None]
Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

POLISH_ITERATIONS = 25
"""Enough for every case seen; the polish stops when it has converged."""

RINGS_ON = 0.05
"""Share of a mode that may be left at the end of the record: three time constants have passed."""

UNPOLISHED = "polish failed: pole taken from the model orders, with a wider uncertainty"
AT_PEAK = "pole from its peak alone: a fit together with the other modes loses it"
ANCHORED = "pole from single hits: a fit of all hits together moves away from the peak"
RESTLESS = "polish has not converged: the remaining step is included in the uncertainty"


def identify(
    frfs: FrfSet,
    settings: ModalSettings,
    progress: Progress | None = None,
    peaks: KnownPeaks = NO_PEAKS,
    wanted: KnownPeaks = NO_PEAKS,
) -> ModalModel:
    """Identify the modes that the FRFs show, with uncertainties.

    Parameters
    ----------
    frfs : FrfSet
    settings : ModalSettings
    progress : callable, optional
        Called with the share done, 0…1, and a few words.
    peaks : KnownPeaks, optional
        Peaks of which single hits show that one mode is there.
    wanted : KnownPeaks, optional
        Poles that make a mode whatever the tests on candidates say of them.

    Returns
    -------
    ModalModel
        Without circle fits, which are attached later.

    Raises
    ------
    EmaError
        Where the band is too narrow or nothing was measured.
    """
    report_progress = progress or (lambda share, text: None)
    with single_blas_thread():
        found = _identify(frfs, settings, report_progress, peaks, wanted)
    release_memory()
    return found


def _identify(
    frfs: FrfSet, settings: ModalSettings, report_progress: Progress, peaks: KnownPeaks, wanted: KnownPeaks
) -> ModalModel:
    band = analysis_band(frfs, settings)
    data = arrange(frfs, band)
    window, level = _first_noise(data, _averaged_lines(frfs, data.transposed))
    seen = seen_band(frfs, band, level)
    if seen != band:
        data = arrange(frfs, seen)
        window, level = _first_noise(data, _averaged_lines(frfs, data.transposed))
    bands = split(data.omega, indicator(data, level))
    iterations = POLISH_ITERATIONS if settings.polish else 0

    def chart_of(part: SubBand) -> PoleSet:
        return _chart_of(window.lines(part.first, part.stop), part, settings)

    charts: list[PoleSet] = []
    for chart in in_order(chart_of, bands):
        charts.append(chart)
        report_progress(
            0.1 + 0.3 * len(charts) / len(bands), f"poles of sub-band {len(charts)} of {len(bands)}"
        )
    release_memory()
    found = candidates(charts, bands, data.measured.shape[1])
    sure, weak = seeded(found.sure, found.weak, peaks, data)
    if len(bands) > 1:
        report_progress(0.4, f"first fit of {len(sure.poles)} candidates")
        sure = first_guess(window, bands, sure, iterations)
    release_memory()
    report_progress(0.6, f"refining {len(sure.poles)} modes, trying {len(weak.poles)} more")

    def search(window: FitData, known: Noise) -> Estimate:
        return tracked(poles_of_all_orders(window, known.mean_log(), 2, settings))

    plain = plain_peaks(frfs, band)
    modes = refined(window, bands, charts, sure, weak, search, iterations, peaks, plain, wanted)
    release_memory()
    report_progress(0.9, "shapes and synthesis")
    cores = [chart.take(between(chart.pole, b.low, b.high)) for chart, b in zip(charts, bands, strict=True)]
    return _model(frfs, settings, band, window, modes, cores, peaks, plain.joined(wanted))


def _averaged_lines(frfs: FrfSet, transposed: bool) -> NDArray[np.int64]:
    """Lines over which the variance of every FRF was averaged, (n_rows, n_references)."""
    lines = (
        np.ones(frfs.frf.shape[:2], dtype=np.int64) if frfs.variance_lines is None else frfs.variance_lines
    )
    return lines.T if transposed else lines


def _first_noise(data: FitData, averaged: NDArray[np.int64]) -> tuple[Window, Real]:
    """Data with noise from hits or a first guess of it, and noise level of every FRF."""
    known = np.array([np.any(row > 0, axis=-1) for row in data.variance]) & data.measured
    if not known.any():
        level = _white_level(data)
        return whole(data, flat_law(level, len(data.omega)), from_hits=False), level
    hits = fit_law(data.variance, data.frf, data.measured, inputs_are_rows=data.transposed, averaged=averaged)
    shape = np.median(hits.shape @ hits.hats, axis=-1)
    once = data.measured & ~known
    if once.any():  # points that were hit once have no scatter
        hits = replace(hits, level=np.where(once, _white_level(data) / shape, hits.level))
    typical = hits.level * shape + hits.floor
    return whole(data, hits, from_hits=True), np.where(data.measured, typical, 1.0)


def _white_level(data: FitData) -> Real:
    """A first guess of the noise of every FRF, from its second differences over lines; 1 where not measured."""
    floor = np.array([np.mean(np.abs(row) ** 2, axis=-1) for row in data.frf])
    second = np.array([second_difference_power(row) for row in data.frf])
    return np.where(data.measured, np.maximum(second, np.maximum(1e-12 * floor, 1e-300)), 1.0)


def _model(
    frfs: FrfSet,
    settings: ModalSettings,
    band: tuple[float, float],
    window: Window,
    modes: FittedModes,
    charts: list[PoleSet],
    peaks: KnownPeaks,
    plain: KnownPeaks,
) -> ModalModel:
    data = window.data
    estimate = Estimate(modes.poles, modes.participation)
    fitted = _synthesis(window, modes)
    # of lines and modes beyond the band, nothing is said
    lines = int(np.count_nonzero(data.omega <= 2 * np.pi * band[1]))
    end = float(data.omega[lines]) if lines < len(data.omega) else np.inf
    modes = modes.take(between(modes.poles, 0.0, end))
    charts = [chart.take(between(chart.pole, 0.0, end)) for chart in charts]
    anchored = modes.held & np.isin(modes.poles, peaks.poles)
    at_peak = modes.held & np.isin(modes.poles, plain.poles)
    # the fit of all hits is a second estimate: as where estimates are pooled, half the way to it is in the interval
    away = 0.5 * np.stack([modes.away.real, modes.away.imag], axis=-1)
    at_peaks = _scatter_at(peaks, modes.poles) + away[:, :, None] * away[:, None, :]
    pole_cov = np.where(anchored[:, None, None], at_peaks, modes.pole_cov)
    pole_cov = np.where(at_peak[:, None, None], _scatter_at(plain, modes.poles), pole_cov)
    order = np.argsort(np.abs(modes.poles))
    rows, references = frfs.outputs, frfs.inputs
    if data.transposed:
        rows, references = references, rows
    shapes = np.where(data.measured.any(axis=1), modes.shapes, np.nan)
    physical = modes.poles + frfs.response_decay_rad_s
    scaled = scale_shapes(
        rows,
        references,
        physical[order],
        shapes[order],
        modes.shape_stds[order],
        modes.shape_own[order],
        modes.participation[order],
        modes.participation_stds[order],
        calibrated=frfs.force_calibrated,
    )
    by_turns = spread_of_turns(frfs, scaled.dofs, scaled.shapes)
    note = scaling_note(any(d in rows for d in references), frfs.force_calibrated)
    chart, stability = _chart(charts, modes.poles[order], frfs.response_decay_rad_s)
    result = tuple(
        _mode(
            complex(physical[j]),
            pole_cov[j],
            scaled.shapes[k],
            np.hypot(scaled.stds[k], by_turns[k]),
            np.hypot(scaled.own_stds[k], by_turns[k]),
            settings.engine,
            float(stability[k]),
            float(scaled.scale_std[k]),
            [
                *_record_flags(float(np.exp(modes.poles[j].real * data.rest_s))),
                *_held_flags(modes.held[j], anchored[j], at_peak[j]),
                *([RESTLESS] if settings.polish and modes.restless[j] and not modes.held[j] else []),
            ],
        )
        for k, j in enumerate(order)
    )
    lost = left_out(charts, plain, estimate, frfs.response_decay_rad_s)
    return ModalModel(
        dofs=scaled.dofs,
        modes=result,
        band_hz=(float(band[0]), float(band[1])),
        scaled=not note,
        scaling_note=note,
        references=references,
        frequency_hz=data.omega[:lines] / (2 * np.pi),
        synthesis=fitted[..., :lines],
        outputs=frfs.outputs,
        inputs=frfs.inputs,
        chart=chart,
        notes=(*_notes(data, note), *sentences(lost)),
        left_out=lost,
    )


def _scatter_at(peaks: KnownPeaks, poles: Complex) -> Real:
    """Covariance of (Re s, Im s) over hits of the peak nearest to each pole, (n_modes, 2, 2)."""
    out = np.zeros((len(poles), 2, 2))
    if len(peaks.poles):
        nearest = np.argmin(np.abs(poles[:, None] - peaks.poles[None]), axis=1)
        out[:, [0, 1], [0, 1]] = peaks.std[nearest] ** 2
    return out


def _mode(
    pole: complex,
    cov: Real,
    shape: Complex,
    std: Real,
    own_std: Real,
    method: str,
    stability: float,
    scale_std: float,
    flags: list[str],
) -> Mode:
    size = abs(pole)
    along = np.array([pole.real, pole.imag]) / size
    zeta = -pole.real / size
    across = np.array([-1.0 / size + pole.real**2 / size**3, pole.real * pole.imag / size**3])
    if np.isfinite(scale_std) and scale_std > 0.1:
        how_well = f"uncertain by {100 * scale_std:.0f} %" if scale_std <= 1 else "not determined"
        flags.append(f"scale {how_well}: the driving point lies near a node")
    if zeta <= 0:
        flags.append("damping not above zero after the window's share was taken off")
    return Mode(
        frequency_hz=float(size / (2 * np.pi)),
        frequency_std_hz=float(np.sqrt(along @ cov @ along) / (2 * np.pi)),
        damping_ratio=float(zeta),
        damping_std=float(np.sqrt(across @ cov @ across)),
        pole=pole,
        shape=shape,
        shape_std=std,
        shape_own_std=own_std,
        mpc=float(mpc(shape)),
        method=method,
        stability=stability,
        flags=tuple(flags),
    )


def _held_flags(held: bool, anchored: bool, at_peak: bool) -> list[str]:
    """Why a pole is not where the fit of all FRFs would have it."""
    if anchored:
        return [ANCHORED]
    if at_peak:
        return [AT_PEAK]
    return [UNPOLISHED] if held else []


def _record_flags(left: float) -> list[str]:
    """What is left of a mode at the end of the record, over its start, said where that is too much."""
    if left <= RINGS_ON:
        return []
    return [
        f"decays longer than the record ({100 * left:.2g} % left at its end): damping relies on the leakage model"
    ]


def _chart(charts: list[PoleSet], poles: Complex, decay: float) -> tuple[StabilisationChart, Real]:
    """Chart of all sub-bands, and each mode's share of the orders in the upper half of its chart."""
    selected, stable = [], []
    share = np.zeros(len(poles))
    for chart in charts:
        stable.append(link(chart).stable)
        found, choice = votes(chart, poles)
        share = np.maximum(share, found)
        selected.append(choice)
    physical = [chart.pole + decay for chart in charts]
    pole = np.concatenate(physical)
    return StabilisationChart(
        order=np.concatenate([c.order for c in charts]).astype(np.int64),
        frequency_hz=np.abs(pole) / (2 * np.pi),
        damping_ratio=-pole.real / np.abs(pole),
        stable=np.concatenate(stable),
        selected=np.concatenate(selected).astype(np.int64),
    ), share


def _synthesis(window: Window, modes: FittedModes) -> NDArray[np.complex64]:
    """Accelerance of the modes and residual terms, in the order (outputs, inputs); NaN where not measured."""
    data = window.data
    total = np.empty(data.frf.shape, dtype=np.complex64)
    estimate = Estimate(modes.poles, modes.participation)

    def fill(rows: slice) -> None:
        some = data.rows(rows)
        fitted = synthesis(some, estimate, modes.shapes.T[rows])
        noise = window.noise.rows(rows).at(some.frf)
        fitted += residual_fit(some, noise.weight(some.measured), fitted)
        fitted[~some.measured] = np.nan
        total[rows] = fitted

    for _ in in_order(fill, data.row_blocks(FEW_AT_ONCE)):
        pass
    return np.asarray(total.swapaxes(0, 1) if data.transposed else total)


def _chart_of(window: Window, part: SubBand, settings: ModalSettings) -> PoleSet:
    """Poles of all orders of a sub-band, from all rows: a few combinations of them lose weak modes."""
    data = window.data
    noise = [window.noise.rows(rows).at(data.frf[rows]).mean_log() for rows in data.row_blocks()]
    return poles_of_all_orders(data, np.concatenate(noise), part.n_peaks, settings)


def _notes(data: FitData, scaling: str) -> tuple[str, ...]:
    notes = [scaling] if scaling else []
    if data.measured.shape[1] == 1:
        notes.append(
            "one reference cannot show a multiplicity: modes of equal frequency appear as one; excite or "
            "measure at a second point to separate them"
        )
    return tuple(notes)
