"""Heavily damped poles without a peak: whether they are modes, or mend what a fit leaves over.

A structure that is not quite linear leaves a misfit that poles with much damping follow well. A mode shows a peak, or
else one shape wherever it is excited; what only mends a misfit shows neither.
"""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ema_pipeline.modal.assurance import mpc
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, LinearSolution, solve_linear
from ema_pipeline.modal.maxima import prominent_peaks
from ema_pipeline.modal.segment import broad

Real = NDArray[np.float64]

HEAVY = 0.02
"""Damping ratio below which a pole that is needed makes a peak, if only a small one."""

RISE_DB = 1.0
"""A peak rises by so much out of the response of all FRFs."""

PLAIN_RISE_DB = 2.0
"""The same of a peak in a response that is smoothed less than its width: drift between hits makes waves of 1 dB."""

SMOOTHING = 0.35
"""Most smoothing of the response for the peak of a pole, in its decay rate: noise makes narrower peaks."""

FALL_DB = 3.0
"""Half a decay rate off, the peak of a pole alone has fallen by 1 dB (less on a plateau), one half as wide by 3 dB."""

NOISE_RISES = 6.0
"""Standard deviations from the lowest to the highest of the lines around a pole that noise may reach."""

FEWEST_LINES = 10
"""Lines around a pole that tell the noise of the response there."""

BROAD_STD = 0.05
"""Relative standard deviation up to which the damping of such a pole must be known."""

UNSEEN = 0.1
"""Share of model orders below which no order can be said to show a pole."""

COLLINEAR = 0.9
"""Modal phase collinearity of a shape that is a mode's without further question."""

ONE_SHAPE = 0.9
"""Share of the largest singular value in the power of free residues that is a mode's without further question."""


def unearned(
    data: FitData,
    weight: Real,
    estimate: Estimate,
    solution: LinearSolution,
    share: Real,
    explained: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Heavily damped poles that have no peak and nothing else that speaks for a mode, (n_modes,).

    Parameters
    ----------
    data : FitData
    weight : ndarray, (n_rows, n_references, n_lines)
    estimate, solution
        The fit.
    share : ndarray, (n_modes,)
        Share of model orders that show each mode.
    explained : ndarray of bool, (n_modes,)
        True where the scatter over hits explains all that is left over around a mode.
    """
    zeta = -estimate.poles.real / np.abs(estimate.poles)
    out = np.zeros(len(zeta), dtype=bool)
    suspects = np.flatnonzero(zeta > HEAVY)
    if not len(suspects):
        return out
    weight = _of_frfs(weight)
    power = np.sum(weight * np.abs(data.frf) ** 2, axis=(0, 1))
    suspects = np.array(
        [r for r in suspects if not has_peak(data.omega, power, estimate.poles[r])], dtype=int
    )
    out[suspects] = share[suspects] < UNSEEN
    doubtful = [
        r
        for r in suspects
        if not out[r]
        and not explained[r]
        and mpc(solution.shapes[:, r]) < COLLINEAR
        and len(solution.shapes) > 2
    ]
    if doubtful and data.measured.shape[1] > 1:
        ranks = one_shape(data, weight, estimate)
        out[doubtful] = ranks[doubtful] < ONE_SHAPE
    return out


def too_broad(
    data: FitData, weight: Real, estimate: Estimate, explained: NDArray[np.bool_], std: Real
) -> NDArray[np.bool_]:
    """Very heavily damped poles that are no modes, (n_modes,).

    One is a mode where nothing but the scatter between hits is left over, its damping is known well, by the relative
    `std` (n_modes,), and it has one shape wherever it is excited. The other parameters are those of `unearned`.
    """
    suspect = broad(estimate)
    out = suspect & ~(explained & (std < BROAD_STD))
    if np.any(suspect & ~out) and data.measured.shape[1] > 1:
        out |= suspect & (one_shape(data, _of_frfs(weight), estimate) < ONE_SHAPE)
    return np.asarray(out)


def _of_frfs(weight: Real) -> Real:
    """One weight per FRF: weights over lines take the peaks away where a fit leaves a share of them."""
    return np.broadcast_to(np.median(weight, axis=-1, keepdims=True), weight.shape)


def has_peak(omega: Real, power: Real, pole: complex) -> bool:
    """True where the response rises to a peak within a half-power half-width of a pole.

    Smoothing by the width of the pole fills the dip between it and another mode. So the response is also looked at
    smoothed only as far as its noise asks for; a peak then counts where it is about as wide as that of the pole, and
    not the narrow one of another mode.
    """
    step = float(omega[1] - omega[0])
    most = max(-SMOOTHING * pole.real / step, 1.0)
    if len(_peaks_near(omega, _smoothed(power, most), pole)):
        return True
    least = max(min(_lines_over_noise(omega, power, pole), most), 1.0)
    curve = _smoothed(power, least)
    aside = max(round(-0.5 * pole.real / step), 1)
    for peak in _peaks_near(omega, curve, pole, PLAIN_RISE_DB):
        beside = curve[np.clip([peak - aside, peak + aside], 0, len(curve) - 1)]
        if RISE_DB <= curve[peak] - beside.mean() < FALL_DB:
            return True
    return False


def _smoothed(power: Real, lines: float) -> Real:
    """Response in decibels, smoothed."""
    return _decibels(scipy.ndimage.gaussian_filter1d(power, lines, mode="nearest"))


def _peaks_near(omega: Real, curve: Real, pole: complex, rise_db: float = RISE_DB) -> NDArray[np.int64]:
    peaks, _ = prominent_peaks(curve, rise_db)
    return peaks[np.abs(omega[peaks] - pole.imag) < max(-pole.real, 2 * float(omega[1] - omega[0]))]


def _lines_over_noise(omega: Real, power: Real, pole: complex) -> float:
    """Standard deviation, in lines, of the Gaussian that leaves noise around a pole less than a peak rises by."""
    near = np.abs(omega - pole.imag) < -2 * pole.real
    if np.count_nonzero(near) < FEWEST_LINES:
        return np.inf
    noise = float(np.sqrt(np.mean(np.diff(_decibels(power[near]), n=2) ** 2) / 6))
    # white noise smoothed over s lines keeps 1/√(2√π·s) of its standard deviation
    return (NOISE_RISES * noise / RISE_DB) ** 2 / (2 * np.sqrt(np.pi))


def _decibels(power: Real) -> Real:
    return np.asarray(10 * np.log10(np.maximum(power, 1e-300)))


def one_shape(data: FitData, weight: Real, estimate: Estimate) -> Real:
    """Share of the first singular value in the power of each mode's residues, fitted freely, (n_modes,)."""
    n_modes, n_ref = len(estimate.poles), data.measured.shape[1]
    free = Estimate(estimate.poles, np.ones((n_modes, 1), dtype=np.complex128))
    residues = np.empty((n_modes, len(data.measured), n_ref), dtype=np.complex128)
    for i in range(n_ref):
        column = data.reference(i)
        residues[:, :, i] = solve_linear(column, weight[:, [i]], free).shapes.T
    scale = np.sqrt(np.mean(weight, axis=-1))
    values = np.linalg.svd(residues * scale, compute_uv=False) ** 2
    return np.asarray(values[:, 0] / np.maximum(values.sum(axis=1), 1e-300))
