"""FRFs in, modes out: the whole of modal identification in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.assurance import mpc
from ema_pipeline.modal.bands import SubBand, indicator, split
from ema_pipeline.modal.credibility import MIN_VOTES, PLAIN_DAMPING, credible, significant
from ema_pipeline.modal.data import FitData, analysis_band, arrange
from ema_pipeline.modal.engines import poles_of_all_orders
from ema_pipeline.modal.fit import (
    Estimate,
    free_participations,
    normalised,
    residual_fit,
    solve_linear,
    synthesis,
)
from ema_pipeline.modal.noise import Noise, fit_noise, second_difference_power
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.scaling import scale_shapes, scaling_note
from ema_pipeline.modal.segment import SegmentFit, fit_segment
from ema_pipeline.modal.selection import Tracks, link, votes
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.modal.types import ModalModel, Mode, StabilisationChart
from ema_pipeline.modal.uncertainty import covariance
from ema_pipeline.threads import single_blas_thread

Progress = Callable[[float, str], None]
Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

POLISH_ITERATIONS = 25
FIRST_ITERATIONS = 4


@dataclass(frozen=True)
class _Modes:
    """Final modes before they are scaled: one entry per mode."""

    poles: Complex
    pole_cov: Real
    shapes: Complex
    shape_stds: Real
    participation: Complex
    participation_stds: Real


def identify(frfs: FrfSet, settings: ModalSettings, progress: Progress | None = None) -> ModalModel:
    """Identify the modes that the FRFs show, with uncertainties.

    Parameters
    ----------
    frfs : FrfSet
    settings : ModalSettings
    progress : callable, optional
        Called with the share done, 0…1, and a few words.

    Returns
    -------
    ModalModel
        Without circle fits, which are attached later.

    Raises
    ------
    EmaError
        Where the band is too narrow or nothing was measured.
    """
    tell = progress or (lambda share, text: None)
    with single_blas_thread():
        return _identify(frfs, settings, tell)


def _identify(frfs: FrfSet, settings: ModalSettings, tell: Progress) -> ModalModel:
    band = analysis_band(frfs, settings)
    data = arrange(frfs, band)
    hits, start, level = _first_noise(data)
    bands = split(data.omega, indicator(data, level))
    iterations = POLISH_ITERATIONS if settings.polish else 0

    charts: list[PoleSet] = []
    found = Estimate(np.zeros(0, complex), np.zeros((0, data.measured.shape[1]), complex))
    for k, part in enumerate(bands):
        tell(0.1 + 0.4 * k / len(bands), f"poles of sub-band {k + 1} of {len(bands)}")
        lines = data.lines(part.first, part.stop)
        poles = poles_of_all_orders(lines, _cut(start, part).variance, part.n_peaks, settings)
        charts.append(poles)
        estimate = _candidates(poles, link(poles))
        found = _stitched(found, estimate.take(_between(estimate.poles, part.low, part.high)))
    if len(bands) > 1:
        found = _first_guess(data, hits, start, bands, found, min(iterations, FIRST_ITERATIONS), tell)
    tell(0.7, f"refining {len(found.poles)} modes")
    modes = _refined(data, hits, start, bands, charts, found, iterations)
    charts = [_inside(poles, part) for poles, part in zip(charts, bands, strict=True)]
    tell(0.9, "shapes and synthesis")
    return _model(frfs, settings, band, data, start, modes, charts)


def _first_noise(data: FitData) -> tuple[Noise | None, Noise, Real]:
    """Noise from hits, first guess of the noise, and noise level of every FRF."""
    known = np.isfinite(data.variance).any()
    second = np.maximum(second_difference_power(data.frf), 1e-300)
    floor = 1e-12 * np.mean(np.abs(data.frf) ** 2, axis=-1)
    level = np.where(data.measured, np.maximum(second, np.maximum(floor, 1e-300)), 1.0)
    if known:
        hits = fit_noise(data.variance, data.frf, data.measured, inputs_are_rows=data.transposed)
        level = np.where(data.measured, np.median(hits.own, axis=-1), 1.0)
        return hits, hits, level
    own = np.broadcast_to(level[..., None], data.frf.shape).copy()
    return None, Noise(1e-4 * np.abs(data.frf) ** 2, own), level


def _cut(noise: Noise, part: SubBand) -> Noise:
    lines = slice(part.first, part.stop)
    return Noise(noise.common[..., lines], noise.own[..., lines])


def _known(noise: Noise | None, part: SubBand) -> Noise | None:
    return None if noise is None else _cut(noise, part)


def _voters(poles: PoleSet) -> Callable[[Estimate], Real]:
    """Share of the orders of a chart that show each mode of an estimate."""
    return lambda estimate: votes(poles, estimate.poles)[0]


def _candidates(poles: PoleSet, tracks: Tracks) -> Estimate:
    """Poles that stand for the tracks; those that only shape a background need more than a few orders."""
    index = tracks.representative
    slight = (poles.damping_ratio[index] > PLAIN_DAMPING) & (tracks.votes < MIN_VOTES)
    index = index[~slight]
    return Estimate(poles.pole[index], normalised(poles.participation[index]))


def _inside(poles: PoleSet, part: SubBand) -> PoleSet:
    return poles.take(_between(poles.pole, part.low, part.high))


def _stitched(known: Estimate, fresh: Estimate) -> Estimate:
    """Join the modes of the next sub-band; one that was found on both sides of the seam counts once."""
    if not len(known.poles) or not len(fresh.poles):
        return known.joined(fresh)
    last, first = known.poles[-1], fresh.poles[0]
    same = abs(last - first) < 0.3 * min(-last.real, -first.real)
    a, b = known.participation[-1], fresh.participation[0]
    alike = abs(np.vdot(a, b)) ** 2 > 0.8 * np.vdot(a, a).real * np.vdot(b, b).real
    return known.joined(fresh.take(np.arange(1, len(fresh.poles)))) if same and alike else known.joined(fresh)


def _first_guess(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    bands: tuple[SubBand, ...],
    candidates: Estimate,
    iterations: int,
    tell: Progress,
) -> Estimate:
    """Fit of each sub-band on its own, so that far modes can then be taken off the data of the others."""
    found = Estimate(candidates.poles[:0], candidates.participation[:0])
    for k, part in enumerate(bands):
        tell(0.5 + 0.2 * k / len(bands), f"modes of sub-band {k + 1} of {len(bands)}")
        lines = data.lines(part.first, part.stop)
        near = candidates.take(_between(candidates.poles, lines.omega[0], lines.omega[-1]))
        fit = fit_segment(lines, _known(hits, part), _cut(start, part), near, significant, iterations)
        found = _stitched(found, fit.estimate.take(_between(fit.estimate.poles, part.low, part.high)))
    return found


def _between(poles: Complex, low: float, high: float) -> NDArray[np.bool_]:
    return np.asarray((poles.imag >= low) & (poles.imag < high))


def _refined(
    data: FitData,
    hits: Noise | None,
    start: Noise,
    bands: tuple[SubBand, ...],
    charts: list[PoleSet],
    found: Estimate,
    iterations: int,
) -> _Modes:
    """Final fit, sub-band by sub-band, with the modes of the other sub-bands taken off the data."""
    parts: list[_Modes] = []
    if len(found.poles):
        everywhere = solve_linear(data, start.weight(data.measured), found)
        for part, chart in zip(bands, charts, strict=True):
            near = _between(found.poles, data.omega[part.first], data.omega[part.stop - 1])
            if not (near & _between(found.poles, part.low, part.high)).any():
                continue
            lines = data.lines(part.first, part.stop)
            far = synthesis(lines, found.take(~near), everywhere.shapes[:, ~near])
            lines = replace(lines, frf=np.where(lines.measured[..., None], lines.frf - far, 0.0))
            known = _known(hits, part)
            judge = partial(credible, hits=known, votes=_voters(chart))
            fit = fit_segment(lines, known, _cut(start, part), found.take(near), judge, iterations)
            parts.append(_final(lines, fit, part))
    n_rows, n_ref = data.measured.shape
    empty = _Modes(
        np.zeros(0, complex),
        np.zeros((0, 2, 2)),
        np.zeros((0, n_rows), complex),
        np.zeros((0, n_rows)),
        np.zeros((0, n_ref), complex),
        np.zeros((0, n_ref)),
    )
    return _Modes(*(np.concatenate([getattr(p, f.name) for p in [empty, *parts]]) for f in fields(_Modes)))


def _final(lines: FitData, fit: SegmentFit, part: SubBand) -> _Modes:
    """Modes of a sub-band's core with their uncertainties."""
    estimate = fit.estimate
    cov = covariance(lines, fit.noise.weight(lines.measured), estimate, fit.solution, fit.noise)
    core = np.flatnonzero(_between(estimate.poles, part.low, part.high))
    stds = np.array(
        [np.sqrt(0.5 * (cov.shapes[:, 2 * r, 2 * r] + cov.shapes[:, 2 * r + 1, 2 * r + 1])) for r in core]
    )
    return _Modes(
        poles=estimate.poles[core],
        pole_cov=np.array([cov.poles(int(r)) for r in core]).reshape(len(core), 2, 2),
        shapes=fit.solution.shapes.T[core],
        shape_stds=stds.reshape(len(core), len(lines.frf)),
        participation=estimate.participation[core],
        participation_stds=_participation_stds(estimate, cov.parameters)[core],
    )


def _participation_stds(estimate: Estimate, parameters: Real) -> Real:
    m = len(estimate.poles)
    out = np.zeros(estimate.participation.shape)
    for k, (r, i) in enumerate(free_participations(estimate)):
        j = 2 * m + 2 * k
        out[r, i] = np.sqrt(max(0.5 * (parameters[j, j] + parameters[j + 1, j + 1]), 0.0))
    return out


def _model(
    frfs: FrfSet,
    settings: ModalSettings,
    band: tuple[float, float],
    data: FitData,
    start: Noise,
    modes: _Modes,
    charts: list[PoleSet],
) -> ModalModel:
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
        modes.participation[order],
        modes.participation_stds[order],
        calibrated=frfs.force_calibrated,
    )
    note = scaling_note(any(d in rows for d in references), frfs.force_calibrated)
    chart, stability = _chart(charts, modes.poles[order], frfs.response_decay_rad_s)
    result = tuple(
        _mode(
            complex(physical[j]),
            modes.pole_cov[j],
            scaled.shapes[k],
            scaled.stds[k],
            settings.engine,
            float(stability[k]),
            float(scaled.scale_std[k]),
        )
        for k, j in enumerate(order)
    )
    return ModalModel(
        dofs=scaled.dofs,
        modes=result,
        band_hz=(float(band[0]), float(band[1])),
        scaled=not note,
        scaling_note=note,
        references=references,
        frequency_hz=data.omega / (2 * np.pi),
        synthesis=_synthesis(data, start, modes),
        outputs=frfs.outputs,
        inputs=frfs.inputs,
        chart=chart,
        notes=_notes(data, note),
    )


def _mode(
    pole: complex,
    cov: Real,
    shape: Complex,
    std: Real,
    method: str,
    stability: float,
    scale_std: float,
) -> Mode:
    size = abs(pole)
    along = np.array([pole.real, pole.imag]) / size
    zeta = -pole.real / size
    across = np.array([-1.0 / size + pole.real**2 / size**3, pole.real * pole.imag / size**3])
    flags = []
    if np.isfinite(scale_std) and scale_std > 0.1:
        flags.append(f"scale uncertain by {100 * scale_std:.0f} %: the driving point lies near a node")
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
        mpc=float(mpc(shape)),
        method=method,
        stability=stability,
        flags=tuple(flags),
    )


def _chart(charts: list[PoleSet], poles: Complex, decay: float) -> tuple[StabilisationChart, Real]:
    """Chart of all sub-bands, and each mode's share of the orders in the upper half of its sub-band's chart."""
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


def _synthesis(data: FitData, noise: Noise, modes: _Modes) -> Complex:
    """Accelerance of the modes and residual terms, in the order (outputs, inputs)."""
    fitted = synthesis(data, Estimate(modes.poles, modes.participation), modes.shapes.T)
    total = fitted + residual_fit(data, noise.weight(data.measured), fitted)
    total = np.where(data.measured[..., None], total, np.nan)
    return np.asarray(total.swapaxes(0, 1) if data.transposed else total)


def _notes(data: FitData, scaling: str) -> tuple[str, ...]:
    notes = [scaling] if scaling else []
    if data.measured.shape[1] == 1:
        notes.append(
            "one reference cannot show a multiplicity: modes of equal frequency appear as one; hit or measure "
            "at a second point to tell them apart"
        )
    return tuple(notes)
