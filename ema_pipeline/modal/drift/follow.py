"""One or two modes that make a peak, followed from hit to hit.

Hits on other points excite two modes under one peak in another ratio. One pole then seems to move, and by more than
drift moves it. Two poles whose frequencies move by one factor in each hit do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.assurance import mac
from ema_pipeline.modal.drift.local import (
    FOLLOWED,
    LARGEST_STEP,
    SharedPoles,
    filled,
    linear_fit,
    shared_poles,
)
from ema_pipeline.modal.drift.windows import PeakWindow

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

OWN_STEPS = 4
"""Steps from the poles that all hits share to those of each hit."""

FARTHEST = 3.0
"""A hit whose poles lie farther from those of all, in decay rates, does not show the peak."""

ONE_MODE = 0.02
"""Second over first singular value of the residues of a peak over hits, above which more than one mode shows in
it: hits on other points then excite another mixture, which looks like movement."""

PURE = 0.005
"""The same up to which no second mode is looked for."""

APART = (-3.0, -1.5, -0.7, 0.7, 1.5, 3.0)
"""Distances from the first, in half-power half-widths, at which a second mode is looked for."""

PAIR = 0.25
"""Share of what one mode leaves, with a frequency of its own in each hit, that two leave at most."""

FOLLOWED_PAIRS = 3
"""Pairs of modes that are tried in single hits, those first that explain all hits together best."""

ALIKE = 0.9
"""Modal assurance criterion over sensors from which two poles in place of one are one mode, whose frequency moves
within its decay, where residues show but one."""

TWIN = 0.1
"""Distance of two frequencies, in decay rates, up to which two poles are one."""


@dataclass(frozen=True)
class FollowedPeak:
    """A peak in all hits.

    Attributes
    ----------
    poles : complex ndarray, (n_modes,)
        That all hits share, rad/s: one or two.
    moved : complex ndarray, (n_hits,)
        What all of them move by in a hit, over their frequencies: the imaginary part is the frequency's.
    std : ndarray, (n_hits,)
        Standard deviation of its real and imaginary part; ``inf`` where a hit does not show the peak.
    residues : complex ndarray, (n_hits, n_outputs, n_modes)
        0 where a channel was left out.
    share : ndarray, (n_hits, n_modes)
        How much an error of the frequency of each mode counts in `moved`; sums to 1 over modes.
    left : ndarray, (n_hits,)
        Power that the modes leave of the lines.
    """

    poles: Complex
    moved: Complex
    std: Real
    residues: Complex
    share: Real
    left: Real

    @property
    def shown(self) -> NDArray[np.bool_]:
        """Hits that show the peak, (n_hits,)."""
        return np.isfinite(self.std)

    @property
    def of_hits(self) -> Complex:
        """Poles in every hit, rad/s, (n_hits, n_modes)."""
        return np.asarray(self.poles + self.moved[:, None] * self.poles.imag)

    @property
    def single(self) -> bool:
        """True where one mode makes the peak: hits on different points show one and the same shape."""
        return len(self.poles) == 1 and self.second_shape < ONE_MODE

    @property
    def second_shape(self) -> float:
        """Second over first singular value of the residues of the first over hits, each over its σ; 1 of but one."""
        if self.residues.shape[1] < 2 or np.count_nonzero(self.shown) < 2:
            return 1.0
        scaled = self.residues[self.shown, :, 0] / self.std[self.shown, None]
        values = np.linalg.svd(scaled, compute_uv=False)
        return float(values[1] / values[0])

    @property
    def shapes_alike(self) -> float:
        """Modal assurance criterion of the first and the last pole, by the shape over sensors that most hits show."""
        first, last = (np.linalg.svd(self.residues[:, :, m], full_matrices=False)[2][0] for m in (0, -1))
        return float(mac(first, last).item())


def follow_peak(
    window: PeakWindow, frf: Complex, omega: Real, rest_s: float, *, one_point: bool
) -> FollowedPeak | None:
    """Follow a peak from hit to hit; None where no pole is found there.

    Parameters
    ----------
    window : PeakWindow
    frf : complex ndarray, (n_hits, n_outputs, n_lines)
        Accelerance of single hits on the lines of the window; NaN where not measured.
    omega : ndarray, (n_lines,)
    rest_s : float
        Time from hit to end of the record.
    one_point : bool
        True where all hits struck one point: they excite two modes under a peak alike, as if they were one.
    """
    known, data = filled(frf)

    def shared(start: Complex) -> SharedPoles | None:
        return shared_poles(window, start, data, known, omega, rest_s, FOLLOWED)

    alone = shared(np.array([window.pole]))
    one = None if alone is None else _followed(window, alone, data, known, omega, rest_s)
    if one_point or (one is not None and one.second_shape <= PURE):
        return one
    first = window.pole if alone is None else complex(alone.poles[0])
    pairs = [shared(first + np.array([0.0, -1j * apart * first.real])) for apart in APART]
    best, least = one, np.inf if one is None else PAIR * one.left.sum()
    for pair in _distinct([p for p in pairs if p is not None])[:FOLLOWED_PAIRS]:
        two = _followed(window, pair, data, known, omega, rest_s)
        if two.left.sum() < least and not (one is not None and one.single and two.shapes_alike > ALIKE):
            best, least = two, two.left.sum()
    return best


def _distinct(pairs: list[SharedPoles]) -> list[SharedPoles]:
    """Pairs of poles that differ from each other, and the two of each, best first."""
    found: list[SharedPoles] = []
    for pair in sorted(pairs, key=lambda p: -p.explained):
        near = TWIN * -float(pair.poles.real.max())
        known = [np.abs(np.sort(pair.poles.imag) - np.sort(p.poles.imag)).max() < near for p in found]
        if np.ptp(pair.poles.imag) > near and not any(known):
            found.append(pair)
    return found


def _followed(
    window: PeakWindow,
    shared: SharedPoles,
    data: Complex,
    known: NDArray[np.bool_],
    omega: Real,
    rest_s: float,
) -> FollowedPeak:
    """The peak if these modes make it."""
    weight = np.where(known, 1.0 / shared.noise, 0.0)
    hits = [_one_hit(window, shared.poles, d, w, omega, rest_s) for d, w in zip(data, weight, strict=True)]
    return FollowedPeak(shared.poles, *(np.array(of_hits) for of_hits in zip(*hits, strict=True)))


def _one_hit(
    window: PeakWindow, poles: Complex, data: Complex, weight: Real, omega: Real, rest_s: float
) -> tuple[complex, float, Complex, Real, float]:
    """The peak in one hit, all that `FollowedPeak` holds of it: all poles move by one factor."""
    fit = linear_fit(poles, window.neighbours, data, omega, rest_s)
    assert fit is not None  # the shared poles were fitted on as many lines
    equal = np.full(len(poles), 1 / len(poles))
    lost = 0j, np.inf, np.zeros_like(fit.residues), equal, _power(fit.left)
    width = float(np.min(-poles.real / poles.imag))
    moved = 0j
    for _ in range(OWN_STEPS):
        along = fit.residues * poles.imag
        weighted = weight[:, None] * along.conj()
        parts = np.sum((weighted.T @ along) * (fit.derivatives.conj() @ fit.derivatives.T), axis=0).real
        information = float(parts.sum())
        if not information > 0:
            return lost
        step = complex(np.sum(weighted * (fit.left @ fit.derivatives.conj().T))) / information
        moved += step * min(1.0, LARGEST_STEP * width / max(abs(step), 1e-300))
        own = poles + poles.imag * moved
        if abs(moved) > FARTHEST * width or np.any(own.real >= 0):
            return lost
        again = linear_fit(own, window.neighbours * (1 + moved.imag), data, omega, rest_s)
        assert again is not None
        fit = again
    outputs = max(int(np.count_nonzero(weight)), 1)
    dof = max(outputs * (len(omega) - fit.free) - 1, 1)
    spread = float(np.sum(weight[:, None] * np.abs(fit.left) ** 2)) / dof
    residues = np.where(weight[:, None] > 0, fit.residues, 0.0)
    std = float(np.sqrt(0.5 * spread / information))
    return moved, std, residues, parts / information, _power(fit.left)


def _power(left: Complex) -> float:
    return float(np.sum(np.abs(left) ** 2))
