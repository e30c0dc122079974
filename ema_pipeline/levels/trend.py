"""Does a quantity measured in single hits move with their force? A test that holds what it promises.

Every point has a mean of its own, so that points struck with different forces do not count. The noise of each hit
is known; what hits of one point and level scatter beyond it (an unsteady hand, a slow drift) is estimated and
added, and with few hits the uncertainty of that estimate makes the test stricter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2
from scipy.stats import t as student

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

PRIOR_DOF = 4.0
"""Degrees of freedom that the noise known from the FRFs counts for in the scatter of the hits."""

AT_ODDS = 0.2
"""Chance of the observed scatter from noise alone, below which the noise known from the FRFs counts for nothing."""


@dataclass(frozen=True)
class Samples:
    """One quantity of one mode in all single hits that tell something of it.

    Attributes
    ----------
    values, variance : ndarray, (n_hits,)
        The quantity, and its variance from noise alone.
    sheet, cell : ndarray of int, (n_hits,)
        Hits of one sheet have a common mean; those of one cell, too, about the same force.
    log_force, amplitude : ndarray, (n_hits,)
        ln(force), and the square of the mode's amplitude over the largest one.
    """

    values: Real
    variance: Real
    sheet: Integers
    cell: Integers
    log_force: Real
    amplitude: Real


@dataclass(frozen=True)
class Trend:
    """Result of the test.

    Attributes
    ----------
    p : float
        Probability of a trend as clear as this where nothing moves; NaN where it cannot be known.
    slope : float
        Change of the quantity per unit of ln(force), mean over the hits.
    extra_std : float
        Scatter of single hits beyond their noise (1 sigma).
    """

    p: float
    slope: float
    extra_std: float


NOTHING = Trend(float("nan"), float("nan"), 0.0)


def samples(
    values: Real, stds: Real, sheet: Integers, level: Integers, force_n: Real, excitation: Real
) -> Samples:
    """Hits that can be compared: those that tell something, on sheets that were struck at several levels.

    Parameters
    ----------
    values, stds : ndarray, (n_hits,)
        The quantity and its standard deviation from noise; ``inf`` where a hit tells nothing.
    sheet, level : ndarray of int, (n_hits,)
        Hits of one sheet share impact point and sensors.
    force_n : ndarray, (n_hits,)
    excitation : ndarray, (n_hits,)
        Amplitude per force of the mode at the hit's point, in any unit.
    """
    use = np.isfinite(values) & np.isfinite(stds) & (stds > 0)
    for s in set(sheet[use].tolist()):
        if len(set(level[use & (sheet == s)].tolist())) < 2:
            use &= sheet != s
    squares = np.where(use, (force_n * np.nan_to_num(excitation)) ** 2, 0.0)
    cell = sheet * (int(level.max(initial=0)) + 1) + level
    return Samples(
        values[use],
        stds[use] ** 2,
        np.unique(sheet[use], return_inverse=True)[1],
        np.unique(cell[use], return_inverse=True)[1],
        np.log(force_n[use]),
        squares[use] / max(float(squares.max(initial=0.0)), 1e-300),
    )


def trends(modes: Sequence[Samples]) -> tuple[Trend, ...]:
    """Test one quantity of every mode for a trend with force.

    Parameters
    ----------
    modes : sequence of Samples
        Of all modes of the structure.

    Notes
    -----
    Two trends are tried, with ln(force) and with the square of the amplitude (a cubic spring's law), each held
    against two kinds of scatter: within cells, which supposes nothing of the law, and about a straight line per
    sheet, which is not widened by the forces' scatter within a level. The smallest p of the four is multiplied
    by four. Scatter of n hits with ν degrees of freedom counts like this: with w = 1/(σ² + τ²), τ² so that
    chi-square equals ν (Paule & Mandel [1]_), the slope's t value is referred to Student's distribution with
    ν + `PRIOR_DOF` degrees of freedom, its variance scaled by a weighted mean of the observed scatter and 1
    (moderated as in [2]_), never below 1. Where the hits of this mode, or of all modes together, scatter by more
    than their noise, the noise counts for nothing, and ν alone remains.

    References
    ----------
    .. [1] R. C. Paule and J. Mandel, "Consensus values and weighting factors", J. Res. Natl. Bur. Stand. 87,
       1982.
    .. [2] G. K. Smyth, "Linear models and empirical Bayes methods for assessing differential expression",
       Stat. Appl. Genet. Mol. Biol. 3(1), 2004.
    """
    tries = [_tries(s) for s in modes]
    noise_holds = True
    for kind in range(max((len(t) for t in tries), default=0)):
        alike = [t[kind] for t in tries if len(t) > kind]
        chance = chi2.sf(sum(t.noise_only for t in alike), sum(t.dof for t in alike))
        noise_holds = noise_holds and bool(chance > AT_ODDS / 4)
    return tuple(_best(t, noise_holds) for t in tries)


def _tries(given: Samples) -> list[_Try]:
    """The lines and scatters that the hits of one mode suffice for."""
    if not len(given.values):
        return []
    n, sheets, cells = len(given.values), int(given.sheet.max()) + 1, int(given.cell.max()) + 1
    kinds: list[tuple[Callable[[Samples, Real, Real], Real], int]] = [
        (_about_cells, n - cells),
        (_about_lines, n - 2 * sheets),
    ]
    kinds = [k for k in kinds if k[1] > 0] or [(_about_one_slope, n - sheets - 1)]
    regressors = (given.amplitude, given.log_force)
    return [_Try(given, x, about, dof) for about, dof in kinds if dof > 0 for x in regressors]


def _about_cells(given: Samples, regressor: Real, weight: Real) -> Real:
    return _centred(given.values, weight, given.cell)


def _about_lines(given: Samples, regressor: Real, weight: Real) -> Real:
    y, x = (_centred(v, weight, given.sheet) for v in (given.values, regressor))
    strength = np.maximum(np.bincount(given.sheet, weight * x * x), 1e-300)
    return np.asarray(y - (np.bincount(given.sheet, weight * x * y) / strength)[given.sheet] * x)


def _about_one_slope(given: Samples, regressor: Real, weight: Real) -> Real:
    y, x = (_centred(v, weight, given.sheet) for v in (given.values, regressor))
    return np.asarray(y - x * np.sum(weight * x * y) / max(float(np.sum(weight * x * x)), 1e-300))


class _Try:
    """A straight line in one regressor, and the scatter that it is held against."""

    def __init__(
        self, given: Samples, regressor: Real, about: Callable[[Samples, Real, Real], Real], dof: int
    ) -> None:
        self._given, self._regressor, self._about, self.dof = given, regressor, about, dof
        self.noise_only = self._chi_square(0.0)
        self.extra = self._extra()

    def result(self, noise_holds: bool) -> tuple[float, float]:
        """Two-sided p value and slope per ln(force)."""
        given = self._given
        weight = 1.0 / (given.variance + self.extra)
        across = _centred(self._regressor, weight, given.sheet)
        strength = float(np.sum(weight * across**2))
        if strength <= 0:
            return float("nan"), float("nan")
        repeated = self._about is not _about_one_slope
        explained = noise_holds and repeated and chi2.sf(self.noise_only, self.dof) > AT_ODDS
        prior = PRIOR_DOF if explained else 0.0
        scale = max((prior + self._chi_square(self.extra)) / (prior + self.dof), 1.0)
        beta = float(np.sum(weight * across * given.values)) / strength
        p = 2 * float(student.sf(abs(beta) * np.sqrt(strength / scale), prior + self.dof))
        force = _centred(given.log_force, weight, given.sheet)
        return p, beta * float(np.sum(weight * across * force) / np.sum(weight * force**2))

    def _chi_square(self, extra: float) -> float:
        weight = 1.0 / (self._given.variance + extra)
        return float(np.sum(weight * self._about(self._given, self._regressor, weight) ** 2))

    def _extra(self) -> float:
        """Variance to add to every hit so that chi-square about the scatter's centre equals its dof."""
        if self.noise_only <= self.dof:
            return 0.0
        top = float(np.ptp(self._given.values)) ** 2 + float(self._given.variance.max())
        while self._chi_square(top) > self.dof:
            top *= 10
        return float(brentq(lambda extra: self._chi_square(extra) - self.dof, 0.0, top, rtol=1e-4))


def _best(tries: list[_Try], noise_holds: bool) -> Trend:
    results = [(*t.result(noise_holds), t.extra) for t in tries]
    known = [r for r in results if np.isfinite(r[0])]
    if not known:
        return NOTHING
    p, slope, extra = min(known)
    return Trend(min(1.0, len(tries) * p), slope, float(np.sqrt(extra)))


def birge_ratio(values: Real, stds: Real, groups: Integers) -> float:
    """How many times their noise values of one group scatter; at least 1, and near 1 where there are few."""
    weight = stds**-2.0
    dof = len(values) - len(np.unique(groups))
    chi_square = float(
        np.sum(weight * _centred(values, weight, np.unique(groups, return_inverse=True)[1]) ** 2)
    )
    return float(np.sqrt(max((PRIOR_DOF + chi_square) / (PRIOR_DOF + dof), 1.0)))


def shifts(values: Real, stds: Real, sheet: Integers, level: Integers, found: Trend) -> tuple[Real, Real]:
    """Mean difference of every level from the softest one, and its standard deviation, (n_levels,).

    Only hits of one sheet are compared; NaN where no sheet leads from one level to the other.
    """
    n_levels = int(level.max()) + 1
    shift, std = np.full((2, n_levels), np.nan)
    shift[0] = std[0] = 0.0
    use = np.isfinite(values) & np.isfinite(stds) & (stds > 0)
    if not use.any():
        return shift, std
    weight = 1.0 / np.sqrt(stds[use] ** 2 + found.extra_std**2)
    sheets = _dummies(sheet[use])
    levels = np.asarray(level[use][:, None] == np.arange(1, n_levels)[None], dtype=float)
    design = np.hstack([levels, sheets]) * weight[:, None]
    size = np.sqrt(np.maximum(np.sum(design**2, axis=0), 1e-300))
    left, values_, right = np.linalg.svd(design / size, full_matrices=False)
    good = values_ > 1e-8 * values_[0]
    inverse = (right[good].T / values_[good]) @ left[:, good].T
    solution = inverse @ (weight * (values[use] - values[use].mean())) / size
    # a level that the data do not tie to the softest one shows in the null space
    tied = np.abs(right[~good][:, : n_levels - 1]).max(axis=0, initial=0.0) < 1e-6
    known = tied & (levels.sum(axis=0) > 0)
    shift[1:][known] = solution[: n_levels - 1][known]
    std[1:][known] = (np.sqrt(np.sum(inverse**2, axis=1)) / size)[: n_levels - 1][known]
    return shift, std


def holm(p_values: Real) -> Real:
    """Adjusted p values: below α where a test is rejected at a family-wise rate of α; NaN stays NaN.

    References
    ----------
    S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Stat. 6, 1979.
    """
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known])]
    out = np.full(len(p_values), np.nan)
    out[order] = np.minimum(np.maximum.accumulate(p_values[order] * np.arange(len(order), 0, -1)), 1.0)
    return out


def _dummies(groups: Integers) -> Real:
    """One column per group."""
    return np.asarray(groups[:, None] == np.unique(groups)[None], dtype=float)


def _centred(values: Real, weight: Real, groups: Integers) -> Real:
    """Values less the weighted mean of their group."""
    means = np.bincount(groups, weight * values) / np.bincount(groups, weight)
    return np.asarray(values - means[groups])
