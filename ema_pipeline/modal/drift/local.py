"""Poles of one peak from the lines around it, residues free in every FRF.

No mode shape is needed for it: a wrong one, as a fit of hits that do not belong together gives, would hide what is
looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import pole_functions
from ema_pipeline.modal.drift.windows import PeakWindow

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

SHARED_STEPS = 8
"""Steps of the pole that all hits share."""

LARGEST_STEP = 0.5
"""Largest step of a pole, in its decay rate."""

RINGS_ON = 0.7
"""Share of a peak left at the end of the record above which it is a tone, not a decay."""

EXPLAINED = 0.9
"""Share of what a straight background leaves of the lines around a peak that one pole explains of a plain one."""

FOLLOWED = 0.7
"""The same for a peak that is followed from hit to hit: noise makes peaks that poles explain worse."""

FEWEST_LEFT = 6
"""Lines beyond the unknowns without which nothing is said of what a peak does within a decay."""

MOST_ALIKE = 0.95
"""Largest correlation of neighbouring lines that is reckoned with: it is known from few lines."""

MAX_DAMPING = 0.2
"""A pole with more is no peak."""


@dataclass(frozen=True)
class DecayChange:
    """What the frequency of one peak does within a decay.

    Attributes
    ----------
    pole : complex
        rad/s.
    change : float
        Frequency at the start of the decay over that at its end, rad/s.
    std : float
        From noise.
    """

    pole: complex
    change: float
    std: float

    @property
    def width(self) -> float:
        """Of the peak at half its power, rad/s: it is no narrower than what its frequency runs through."""
        return -2 * self.pole.real

    @property
    def single(self) -> bool:
        """False where one mode does not describe the decay: past the width the first order says nothing."""
        return abs(self.change) <= self.width


@dataclass(frozen=True)
class PeakResidues:
    """Residues of a peak at one pole for all FRFs.

    Attributes
    ----------
    residues : complex ndarray, (n_inputs, n_outputs)
        0 where not known.
    variance : ndarray, (n_inputs, n_outputs)
        E|r - E r|² of each, from what the fit leaves of its FRF; infinite where not known.
    """

    residues: Complex
    variance: Real


@dataclass(frozen=True)
class SharedPoles:
    """Poles that fit all hits best.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
        rad/s.
    noise : ndarray, (n_outputs,)
        Power that they leave, over the largest.
    explained : float
        Share of what a straight background leaves that they explain.
    """

    poles: Complex
    noise: Real
    explained: float


@dataclass(frozen=True)
class LinearFit:
    """Fit of some FRFs at given poles.

    Attributes
    ----------
    residues : complex ndarray, (n_frfs, n_modes)
    left : complex ndarray, (n_frfs, n_lines)
    derivatives : complex ndarray, (n_modes, n_lines)
        By the poles, what residues and background cannot follow.
    free : int
        Number of coefficients of each FRF.
    gain : float
        Variance of a residue of the first mode over that of a line.
    """

    residues: Complex
    left: Complex
    derivatives: Complex
    free: int
    gain: float


def change_in_decay(
    window: PeakWindow, frf: Complex, pole: complex, omega: Real, rest_s: float
) -> DecayChange | None:
    """Change of a peak's frequency within the decay after one hit; None where the lines are too few to tell.

    Where frequency depends on the square of the amplitude, as that of a cubic spring does, it settles as exp(−2σt). To
    first order the decay then is exp(st)·(1 + c·exp(−2σt)) at every sensor: a second pole, which decays three times as
    fast at the same frequency, has one share c in all residues. The frequency starts 2σ·Im c below where it ends.

    Parameters
    ----------
    window : PeakWindow
    frf : complex ndarray, (n_outputs, n_lines)
        Accelerance of the hit on the lines of the window; NaN where not measured.
    pole : complex
        Of the peak in this hit, rad/s.
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.
    """
    data = frf[np.isfinite(frf).all(axis=-1)]
    fit = linear_fit(np.array([pole]), window.neighbours, data, omega, rest_s)
    if fit is None or len(omega) < fit.free + FEWEST_LEFT:
        return None
    noise = np.maximum(np.mean(np.abs(fit.left) ** 2, axis=1), 1e-300)
    residues = fit.residues[:, 0]
    # all sensors share c, and the force's noise: they are one curve
    curve = residues.conj() / noise @ fit.left / float(np.sum(np.abs(residues) ** 2 / noise))
    fast = pole_functions(omega, np.array([complex(3 * pole.real, pole.imag)]), rest_s)[0]
    across = _across(fast, pole, window.neighbours, omega, rest_s)[0]
    columns = np.stack([across, fit.derivatives[0]], axis=1)
    shares, _, rank, _ = np.linalg.lstsq(columns, curve, rcond=None)
    if rank < 2:
        return None
    left = curve - columns @ shares
    power = float(np.sum(np.abs(left) ** 2)) / (len(omega) - fit.free - 2)
    spread = np.sqrt(0.5 * power * np.linalg.inv(columns.conj().T @ columns)[0, 0].real)
    twice = -2 * pole.real
    return DecayChange(pole, float(-twice * shares[0].imag), float(twice * spread))


def plain_pole(window: PeakWindow, frf: Complex, omega: Real, rest_s: float) -> complex | None:
    """Pole that all FRFs share at a peak; None where one pole does not explain the peak.

    Parameters
    ----------
    window : PeakWindow
    frf : complex ndarray, (n_inputs, n_outputs, n_lines)
        Accelerance on the lines of the window; NaN where not measured.
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.
    """
    known, data = filled(frf)
    shared = shared_poles(window, np.array([window.pole]), data, known, omega, rest_s, EXPLAINED)
    return None if shared is None else complex(shared.poles[0])


def peak_residues(window: PeakWindow, frf: Complex, omega: Real, rest_s: float) -> PeakResidues | None:
    """Residues of a peak in all FRFs; None where no pole is found at the peak.

    Parameters
    ----------
    window : PeakWindow
    frf : complex ndarray, (n_inputs, n_outputs, n_lines)
        Accelerance on the lines of the window; NaN where not measured.
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.
    """
    known, data = filled(frf)
    shared = shared_poles(window, np.array([window.pole]), data, known, omega, rest_s, FOLLOWED)
    if shared is None:
        return None
    fit = linear_fit(shared.poles, window.neighbours, data.reshape(-1, len(omega)), omega, rest_s)
    if fit is None or len(omega) <= fit.free:
        return None
    power = np.sum(np.abs(fit.left) ** 2, axis=-1) / (len(omega) - fit.free) * _serial(fit.left)
    variance = fit.gain * power.reshape(known.shape)
    known &= variance > 0
    residues = np.where(known, fit.residues[:, 0].reshape(known.shape), 0.0)
    return PeakResidues(residues, np.where(known, variance, np.inf))


def _serial(left: Complex) -> Real:
    """How much more the variance of a coefficient is than if what is left on neighbouring lines were independent.

    What bends under a peak is no noise, and moves the residue by more than noise of that size.

    Parameters
    ----------
    left : complex ndarray, (n_frfs, n_lines)
    """
    power = np.maximum(np.sum(np.abs(left) ** 2, axis=-1), 1e-300)
    alike = np.sum((left[:, 1:] * left[:, :-1].conj()).real, axis=-1) / power
    alike = np.clip(alike, 0.0, MOST_ALIKE)
    return np.asarray((1 + alike) / (1 - alike))


def _explained(poles: Complex, window: PeakWindow, data: Complex, omega: Real, rest_s: float) -> float:
    """Share of what a straight background leaves of the FRFs that poles explain."""
    flat = data.reshape(-1, len(omega))
    fit = linear_fit(poles, window.neighbours, flat, omega, rest_s)
    if fit is None:
        return 0.0
    basis = np.linalg.qr(np.stack([np.ones(len(omega)), np.linspace(-1, 1, len(omega))]).T)[0]
    without = float(np.sum(np.abs(flat - (flat @ basis) @ basis.T) ** 2))
    return 1.0 - float(np.sum(np.abs(fit.left) ** 2)) / max(without, 1e-300)


def filled(frf: Complex) -> tuple[NDArray[np.bool_], Complex]:
    """Which FRFs were measured, and all of them with 0 in place of the others."""
    known = np.asarray(np.isfinite(frf).all(axis=-1))
    return known, np.where(known[..., None], frf, 0.0)


def shared_poles(
    window: PeakWindow,
    start: Complex,
    data: Complex,
    known: NDArray[np.bool_],
    omega: Real,
    rest_s: float,
    least: float,
) -> SharedPoles | None:
    """Poles that fit all hits best; None where they explain less than `least`.

    Parameters
    ----------
    window : PeakWindow
    start : complex ndarray, (n_modes,)
        First guess, rad/s.
    data : complex ndarray, (n_hits, n_outputs, n_lines)
        Accelerance on the lines of the window; 0 where not measured.
    known : ndarray of bool, (n_hits, n_outputs)
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.
    least : float
        Share of what a straight background leaves.
    """
    poles, flat = start, data.reshape(-1, len(omega))
    noise = np.ones(data.shape[1])
    for _ in range(SHARED_STEPS):
        fit = linear_fit(poles, window.neighbours, flat, omega, rest_s)
        if fit is None:
            return None
        noise = _noise_of_outputs(fit, known)
        poles = _moved(poles, _steps(fit, np.where(known, 1.0 / noise, 0.0).ravel()))
        inside = (omega[0] < poles.imag) & (poles.imag < omega[-1])
        if not np.all(inside & (poles.real < 0) & (-poles.real < MAX_DAMPING * np.abs(poles))):
            return None
    if np.exp(float(poles.real.max()) * rest_s) > RINGS_ON:
        return None
    explained = _explained(poles, window, data, omega, rest_s)
    return None if explained < least else SharedPoles(poles, noise, explained)


def linear_fit(
    poles: Complex, others: Complex, data: Complex, omega: Real, rest_s: float
) -> LinearFit | None:
    """Residues of poles, of their neighbours, and a straight background that fit best, FRF by FRF.

    Parameters
    ----------
    poles, others : complex ndarray
        rad/s.
    data : complex ndarray, (n_frfs, n_lines)
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.

    Returns
    -------
    LinearFit or None
        None where the lines are fewer than the coefficients.
    """
    n = len(poles)
    u, derivative = pole_functions(omega, np.concatenate([poles, others]), rest_s)
    columns = _columns(u)
    if len(columns) + 2 > len(omega):
        return None
    size = np.linalg.norm(u[:n], axis=1)
    basis, triangle = np.linalg.qr(columns.T)
    inside = data @ basis.conj()
    solved = np.linalg.lstsq(triangle, inside.T, rcond=1e-10)[0]
    left = data - inside @ basis.T
    across = derivative[:n] - (derivative[:n] @ basis.conj()) @ basis.T
    gain = float(np.sum(np.abs(np.linalg.pinv(triangle, rcond=1e-10)[0]) ** 2) / size[0] ** 2)
    return LinearFit(solved[:n].T / size, left, across, len(columns), gain)


def _columns(u: Complex) -> Complex:
    """Functions of poles and a straight background, each of norm 1."""
    n = u.shape[1]
    columns = np.concatenate([u, np.ones((1, n)), np.linspace(-1, 1, n)[None]])
    return np.asarray(columns / np.linalg.norm(columns, axis=1, keepdims=True))


def _across(values: Complex, pole: complex, others: Complex, omega: Real, rest_s: float) -> Complex:
    """What poles and background cannot follow of some curves, (n_curves, n_lines)."""
    u = pole_functions(omega, np.concatenate([[pole], others]), rest_s)[0]
    basis = np.linalg.qr(_columns(u).T)[0]
    return np.asarray(values - (values @ basis.conj()) @ basis.T)


def _noise_of_outputs(fit: LinearFit, known: NDArray[np.bool_]) -> Real:
    """Power that the fit leaves of every output, relative to the largest: only the ratios serve as weights."""
    power = np.sum(np.abs(fit.left) ** 2, axis=-1).reshape(known.shape)
    mean = np.where(known, power, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    top = float(mean.max())
    return np.maximum(mean / top if top > 0 else np.ones(len(mean)), 1e-6)


def _steps(fit: LinearFit, weight: Real) -> Complex:
    """Gauss-Newton steps of the poles; `weight` by FRF."""
    weighted = weight[:, None] * fit.residues.conj()
    information = (weighted.T @ fit.residues) * (fit.derivatives.conj() @ fit.derivatives.T)
    slope = np.sum(weighted * (fit.left @ fit.derivatives.conj().T), axis=0)
    return np.asarray(np.linalg.lstsq(information, slope, rcond=1e-10)[0])


def _moved(poles: Complex, steps: Complex) -> Complex:
    limit = LARGEST_STEP * np.abs(poles.real)
    return np.asarray(poles + steps * np.minimum(1.0, limit / np.maximum(np.abs(steps), 1e-300)))
