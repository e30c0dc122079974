"""Circles of every mode in its best FRFs, with the neighbours' circles taken off.

A target is a mode as the FRFs show it: natural frequency and damping ratio with the share of an exponential
window still in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.circle.fit import MINIMUM_POINTS, SdofCircle, fit_circle, sweep
from ema_pipeline.modal.circle.settings import CircleSettings
from ema_pipeline.modal.types import CircleFit, ModalModel
from ema_pipeline.threads import in_order, single_blas_thread

_PASSES = 2  # of refinement; a third changes damping by less than its uncertainty
_CREDIBLE = 0.3  # residual over radius up to which a neighbour's circle may be taken off


@dataclass(frozen=True)
class Target:
    """Where a circle is looked for: natural frequency (Hz) and damping ratio as the FRFs show them."""

    frequency_hz: float
    damping_ratio: float

    @property
    def half_width_hz(self) -> float:
        """Half the half-power bandwidth."""
        return self.frequency_hz * self.damping_ratio


@dataclass(frozen=True)
class Mobilities:
    """Measured FRFs of a set as mobility, one row per output-input pair that was measured.

    Only the lines that are asked for are turned into mobilities: the whole would be as large as the set.

    Attributes
    ----------
    frequency_hz : ndarray, (n_lines,)
        Without 0 Hz.
    frfs : FrfSet
    output, input : ndarray of int, (n_pairs,)
        Index into the set's outputs and inputs.
    """

    frequency_hz: NDArray[np.float64]
    frfs: FrfSet
    output: NDArray[np.int64]
    input: NDArray[np.int64]

    def mobility(self, lines: slice, row: int | slice = slice(None)) -> NDArray[np.complex128]:
        """Mobility of some lines, (n_pairs, n_lines), or of one row, (n_lines,)."""
        frf = self.frfs.frf[..., 1:][..., lines][self.output[row], self.input[row]]
        return np.asarray(frf * self._factor(lines, row))

    def variance(self, lines: slice, row: int | slice = slice(None)) -> NDArray[np.float64]:
        """Their variance; NaN where not known."""
        variance = self.frfs.variance[..., 1:][..., lines][self.output[row], self.input[row]]
        return np.asarray(variance * np.abs(self._factor(lines, row)) ** 2)

    def _factor(self, lines: slice, row: int | slice) -> NDArray[np.complex128]:
        """From the quantity of each output to velocity."""
        jw = 2j * np.pi * self.frequency_hz[lines]
        power = {"acceleration": -1, "velocity": 0, "displacement": 1}
        exponent = np.array([power[q] for q in self.frfs.quantities])[self.output[row]]
        return np.asarray(jw ** exponent[..., None])


def mobilities(frfs: FrfSet) -> Mobilities:
    """Turn all measured FRFs into mobilities; FRFs with values that are not finite are left out."""
    output, input_ = np.nonzero(np.all(np.isfinite(frfs.frf[:, :, 1:]), axis=2))
    return Mobilities(frequency_hz=frfs.frequency_hz[1:], frfs=frfs, output=output, input=input_)


def circle_fits(
    frfs: FrfSet, modal: ModalModel, settings: CircleSettings | None = None
) -> tuple[tuple[CircleFit, ...], ...]:
    """Fit circles to every mode of a modal model in the FRFs that show it best.

    Parameters
    ----------
    frfs : FrfSet
    modal : ModalModel
        Only says around which frequencies to look and how wide; the circles are an estimate of their own.
    settings : CircleSettings, optional

    Returns
    -------
    tuple of tuple of CircleFit
        Per mode, best FRFs first; empty where no circle could be fitted. The share of an exponential window
        is taken off natural frequencies and damping.
    """
    settings = settings or CircleSettings()
    data = mobilities(frfs)
    targets = [seen_in_frfs(mode.pole, frfs.response_decay_rad_s) for mode in modal.modes]
    with single_blas_thread():
        fitted = fit_targets(data, targets, settings)
    return tuple(tuple(to_circle_fit(circle, frfs, data, row) for row, circle in found) for found in fitted)


def seen_in_frfs(pole: complex, decay_rad_s: float) -> Target:
    """Target of a pole, rad/s, to which an exponential window has added `decay_rad_s`."""
    seen = pole - decay_rad_s
    return Target(abs(seen) / (2 * np.pi), max(-seen.real / abs(seen), 1e-6))


def fit_targets(
    data: Mobilities, targets: Sequence[Target], settings: CircleSettings
) -> list[list[tuple[int, SdofCircle]]]:
    """Circles of every target as (row of `data`, circle), best rows first."""

    def of_target(i: int) -> list[tuple[int, SdofCircle]]:
        lines = line_range(data.frequency_hz, targets, i, settings)
        if lines.stop - lines.start < MINIMUM_POINTS:
            return []
        rows = rank_rows(data, targets[i], lines)
        if settings.channels_per_mode != "all":
            rows = rows[: settings.channels_per_mode]
        circles = [(int(row), _fit_refined(data, int(row), targets, i, settings)) for row in rows]
        return [(row, circle) for row, circle in circles if circle is not None]

    return list(in_order(of_target, range(len(targets))))


def line_range(
    frequency_hz: NDArray[np.float64], targets: Sequence[Target], index: int, settings: CircleSettings
) -> slice:
    """Lines for one target: some bandwidths to either side, short of its neighbours.

    Between two modes the border divides their distance by their bandwidths. No border comes closer than the
    half-power points, and there are at least `minimum_points` lines.
    """
    own = targets[index]
    low = own.frequency_hz - 2 * settings.half_width_bandwidths * own.half_width_hz
    high = own.frequency_hz + 2 * settings.half_width_bandwidths * own.half_width_hz
    for other in (t for k, t in enumerate(targets) if k != index):
        share = own.half_width_hz / (own.half_width_hz + other.half_width_hz)
        border = own.frequency_hz + share * (other.frequency_hz - own.frequency_hz)
        if other.frequency_hz > own.frequency_hz:
            high = min(high, max(border, own.frequency_hz + own.half_width_hz))
        elif other.frequency_hz < own.frequency_hz:
            low = max(low, min(border, own.frequency_hz - own.half_width_hz))
    start, stop = (int(k) for k in np.searchsorted(frequency_hz, [low, high]))
    while stop - start < min(settings.minimum_points, frequency_hz.size):
        # widen on the side whose next line is nearer to the mode
        below = own.frequency_hz - frequency_hz[start - 1] if start > 0 else np.inf
        above = frequency_hz[stop] - own.frequency_hz if stop < frequency_hz.size else np.inf
        if below < above:
            start -= 1
        else:
            stop += 1
    return slice(start, stop)


def rank_rows(data: Mobilities, target: Target, lines: slice) -> NDArray[np.int64]:
    """Rows of `data` in falling order of circle diameter over noise.

    The noise is that found over hits, or else the misfit of the mode with a constant.
    """
    diameter, misfit = _linear_diameters(data.frequency_hz[lines], data.mobility(lines), target)
    variance = np.mean(data.variance(lines), axis=1)
    noise = np.where(np.isfinite(variance) & (variance > 0), variance, misfit)
    noise = np.maximum(noise, np.finfo(float).tiny)
    score = np.abs(diameter) / np.sqrt(noise)
    order = np.argsort(-score, kind="stable")
    return np.asarray(order[score[order] > 0], dtype=np.int64)


def to_circle_fit(circle: SdofCircle, frfs: FrfSet, data: Mobilities, row: int) -> CircleFit:
    """Name the FRF and take the exponential window's share off."""
    decay = frfs.response_decay_rad_s
    w_seen = 2 * np.pi * circle.natural_frequency_hz
    frequency, damping = without_window(circle.natural_frequency_hz, circle.damping_ratio, decay)
    w_n = 2 * np.pi * frequency
    return CircleFit(
        output=frfs.outputs[data.output[row]],
        input=frfs.inputs[data.input[row]],
        frequency_hz=circle.frequency_hz,
        points=circle.points,
        centre=circle.centre,
        radius=circle.radius,
        natural_frequency_hz=frequency,
        natural_frequency_std_hz=circle.natural_frequency_std_hz,
        damping_ratio=damping,
        damping_std=circle.damping_std * w_seen / w_n,
        pair_damping=(circle.pair_damping * w_seen - decay) / w_n,
        residual=circle.residual,
        diameter=circle.diameter,
        damping_in_frf=circle.damping_ratio,
    )


def on_circle(circle: CircleFit, frequency_hz: float) -> complex:
    """Where a frequency lies on a fitted circle, (m/s)/N.

    The fitted sweep says where. Angles of the measured lines cannot: from one coarse line to the next the circle may be
    swept by more than half a turn, and which way is then not seen.
    """
    x = sweep(np.array(frequency_hz), circle.natural_frequency_hz, circle.damping_in_frf)
    return complex(circle.centre + circle.diameter * (1 / (1 + 1j * x) - 0.5))


def without_window(frequency_hz: float, damping_ratio: float, decay_rad_s: float) -> tuple[float, float]:
    """Natural frequency (Hz) and damping ratio after `decay_rad_s` is taken off the pole's decay."""
    w = 2 * np.pi * frequency_hz
    root = np.sqrt(max(1 - damping_ratio**2, 0.0))
    pole = complex(-damping_ratio * w + decay_rad_s, root * w)
    return abs(pole) / (2 * np.pi), -pole.real / abs(pole)


def _fit_refined(
    data: Mobilities, row: int, targets: Sequence[Target], index: int, settings: CircleSettings
) -> SdofCircle | None:
    """Circle of one target in one FRF; its neighbours' circles are fitted too and taken off in turn.

    The refined circle is kept only where it explains its lines better than the plain one.
    """
    plain = _fit_once(data, row, line_range(data.frequency_hz, targets, index, settings), 0.0)
    if plain is None or not settings.remove_neighbours or len(targets) == 1:
        return plain
    order = sorted(range(len(targets)), key=lambda k: targets[k].frequency_hz)
    place = order.index(index)
    group = order[max(place - 1, 0) : place + 2]
    ranges = {k: line_range(data.frequency_hz, targets, k, settings) for k in group}
    circles: dict[int, SdofCircle | None] = {
        k: plain if k == index else _fit_once(data, row, ranges[k], 0.0) for k in group
    }
    for _ in range(_PASSES):
        for k in [k for k in group if k != index] + [index]:
            f = data.frequency_hz[ranges[k]]
            others = (circles[m] for m in group if m != k)
            taken = np.zeros(f.size, dtype=np.complex128)
            for other in others:
                if other is not None and other.residual < _CREDIBLE:
                    taken += other.contribution(f)
            refit = _fit_once(data, row, ranges[k], taken, circles[k])
            circles[k] = refit if refit is not None else circles[k]
    refined = circles[index]
    if refined is None or _misfit(refined) > _misfit(plain):
        return plain
    return refined


def _fit_once(
    data: Mobilities,
    row: int,
    lines: slice,
    taken_off: NDArray[np.complex128] | float,
    earlier: SdofCircle | None = None,
) -> SdofCircle | None:
    start = (earlier.natural_frequency_hz, earlier.damping_ratio) if earlier else None
    try:
        return fit_circle(
            data.frequency_hz[lines],
            data.mobility(lines, row) - taken_off,
            data.variance(lines, row),
            start,
        )
    except EmaError:  # too few lines, or no circle at all: this FRF says nothing about the mode
        return None


def _misfit(circle: SdofCircle) -> float:
    return float(np.sum(np.abs(circle.misfit * circle.radius) ** 2))


def _linear_diameters(
    frequency_hz: NDArray[np.float64], mobility: NDArray[np.complex128], target: Target
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Diameter D, (n_pairs,), by linear least squares of B + D/(1 + j x); mean squared misfit, (n_pairs,)."""
    term = 1 / (1 + 1j * sweep(frequency_hz, target.frequency_hz, target.damping_ratio))
    columns = np.stack([np.ones_like(term), term], axis=1)
    solution, *_ = np.linalg.lstsq(columns, mobility.T, rcond=None)
    misfit = mobility.T - columns @ solution
    return np.asarray(solution[1]), np.asarray(np.mean(np.abs(misfit) ** 2, axis=0))
