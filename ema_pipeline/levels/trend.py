"""Does a quantity measured in single hits move with their force? A test that holds what it promises.

Every point has a mean of its own, so that points struck with different forces do not count. The noise of each hit
is known; what hits scatter beyond it about smooth curves over the force is estimated and added, see `scatter`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtr

from ema_pipeline.levels.scatter import NOTHING_USUAL, Scatter, Usual, usual_scatter

Real = NDArray[np.float64]
Integers = NDArray[np.int64]

PRIOR_DOF = 4.0
"""Degrees of freedom that the noise known from the FRFs counts for in the scatter of few hits of a level."""

SHEET_DOF = 1.0
"""Degrees of freedom that the scatter of all sheets counts for in that of one: few, as sheets differ by far."""

LARGEST = 0.99
"""Larger p values count as this: a single one near 1 would undo all others in the Cauchy combination."""


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
    sheet_dof : ndarray, (n_sheets,), or float
        Degrees of freedom of a variance that a sheet's own hits tell; infinite where it is known.
    """

    values: Real
    variance: Real
    sheet: Integers
    cell: Integers
    log_force: Real
    amplitude: Real
    sheet_dof: Real | float = np.inf

    @property
    def square(self) -> Real:
        """Square of the force over the largest one."""
        return np.asarray(np.exp(2 * (self.log_force - self.log_force.max())))

    @property
    def repeated(self) -> bool:
        """True where some hits share point and force."""
        return len(self.values) > int(self.cell.max(initial=-1)) + 1

    def of_sheet(self, sheet: int) -> Samples:
        """Those of one sheet."""
        on = self.sheet == sheet
        return Samples(
            self.values[on],
            self.variance[on],
            np.zeros(np.count_nonzero(on), dtype=np.int64),
            np.unique(self.cell[on], return_inverse=True)[1],
            self.log_force[on],
            self.amplitude[on],
        )


NO_TREND = 0.5
"""P value of a change that is not plain: one that speaks neither for nor against any other test's."""


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

    @property
    def shown_p(self) -> float:
        """P value as it is shown: NaN where the change was too small to be tested."""
        return float("nan") if self.p == NO_TREND else self.p


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


def scattered_by_sheet(given: Samples) -> Samples:
    """The samples with variances that hold what the hits of each sheet scatter more than those of all sheets do.

    `trends` takes all hits of a mode to scatter alike. A sheet that scatters much more would show a trend by chance.
    """
    whole = _scatters(given)
    if whole is None:
        return given
    of_all = whole[0].extra(NOTHING_USUAL)
    variance, dof = given.variance.copy(), np.full(int(given.sheet.max()) + 1, np.inf)
    for s in np.unique(given.sheet):
        on = given.sheet == s
        own = given.of_sheet(int(s))
        alone = _scatters(replace(own, variance=own.variance + of_all))
        if alone is not None and not alone[0].shared:
            extra = alone[0].extra(Usual(1.0, SHEET_DOF))
            variance[on] += extra
            if extra > 0:
                share = extra / (extra + of_all + float(np.median(own.variance)))
                dof[s] = (alone[0].dof + SHEET_DOF) / share**2
    return replace(given, variance=variance, sheet_dof=dof)


def trends(modes: Sequence[Samples]) -> tuple[Trend, ...]:
    """Test one quantity of every mode for a trend with force.

    Parameters
    ----------
    modes : sequence of Samples
        Frequencies and damping ratios of all modes of the structure: together they tell how much hits scatter.

    Notes
    -----
    Hits scatter about curves of two terms, ln(force) and force squared, one curve per sheet, where there are three
    levels with repeated hits, about straight lines otherwise. That supposes little of the law, and hits of one level
    that differ in force do not count as scatter. The scatter is shrunk towards what is usual among all modes
    (`scatter.usual_scatter`), and its variance added to the noise's. Against it four trends are held: with the square
    of the mode's amplitude (a cubic spring's law), with ln(force), with the force squared, and with slopes of every
    sheet's own; the degrees of freedom are those of the scatter and of what is usual together. Their p values are
    combined with `combined`, which holds for any dependence between them. Hits that were never repeated do not tell
    noise from scatter: there nothing is usual.
    """
    scatters = [_scatters(s) for s in modes]
    usual = tuple(usual_scatter(s[kind] for s in scatters if s) for kind in range(2))
    return tuple(_trend(given, found, usual) for given, found in zip(modes, scatters, strict=True))


_Pair = tuple[Scatter, Scatter]
_Terms = tuple[Real, ...]


def _scatters(given: Samples) -> _Pair | None:
    """Scatter of the hits where the force squared acts, and where its logarithm does; None for too few hits."""
    if not len(given.values):
        return None
    square, log = given.square, given.log_force
    levels = max(len(set(given.cell[given.sheet == s])) for s in set(given.sheet.tolist()))
    kinds: list[tuple[_Terms, _Terms, bool]] = [((square,), (log,), False), ((square,), (log,), True)]
    if levels > 2 and given.repeated:
        kinds.insert(0, ((square, log), (square, log), False))
    for of_square, of_log, shared in kinds:
        pair = _scatter(given, of_square, shared), _scatter(given, of_log, shared)
        if min(s.dof for s in pair) > 0:
            return pair
    return None


def _scatter(given: Samples, terms: tuple[Real, ...], shared: bool) -> Scatter:
    return Scatter(given.values, given.variance, given.sheet, terms, shared)


def _trend(given: Samples, scatters: _Pair | None, usual: tuple[Usual, ...]) -> Trend:
    """All trends of one mode held against its scatter."""
    if scatters is None:
        return NOTHING
    known = usual if given.repeated else (NOTHING_USUAL,) * 2
    extra = [s.extra(u) for s, u in zip(scatters, known, strict=True)]
    dof = [s.dof + u.dof for s, u in zip(scatters, known, strict=True)]
    tries = [
        _slope(given, given.amplitude, extra[0], dof[0]),
        _slope(given, given.square, extra[0], dof[0]),
        _slope(given, given.log_force, extra[1], dof[1]),
    ]
    common = min((t for t in tries if np.isfinite(t[0])), default=(float("nan"), float("nan")))
    chances = [p for p, _ in tries]
    if not scatters[0].shared and len(np.unique(given.sheet)) > 1:
        chances.append(_own_slopes(given, given.square, extra[0], dof[0]))
    return Trend(combined(np.array(chances)), common[1], float(np.sqrt(extra[0])))


def _slope(given: Samples, regressor: Real, extra: float, dof: float) -> tuple[float, float]:
    """Two-sided p value of a slope that all sheets share, and the slope per ln(force)."""
    weight = 1.0 / (given.variance + extra)
    across = _centred(regressor, weight, given.sheet)
    strength = float(np.sum(weight * across**2))
    if strength <= 0:
        return float("nan"), float("nan")
    beta = float(np.sum(weight * across * given.values)) / strength
    force = _centred(given.log_force, weight, given.sheet)
    per_log = beta * float(np.sum(weight * across * force) / np.sum(weight * force**2))
    share = np.bincount(given.sheet, weight * across**2) / strength
    dof = min(dof, 1 / max(float(np.sum(share**2 / given.sheet_dof)), 1e-300))  # Welch and Satterthwaite
    return 2 * float(stdtr(dof, -abs(beta) * np.sqrt(strength))), per_log


def _own_slopes(given: Samples, regressor: Real, extra: float, dof: float) -> float:
    """P value of slopes of every sheet's own."""
    weight = 1.0 / (given.variance + extra)
    across = _centred(regressor, weight, given.sheet)
    moved = np.bincount(given.sheet, weight * across * given.values)
    strength = np.bincount(given.sheet, weight * across**2)
    told = strength > 0
    if not told.any():
        return float("nan")
    dof = min(dof, float(np.min(np.where(told, given.sheet_dof, np.inf))))
    return float(fdtrc(int(told.sum()), dof, np.mean(moved[told] ** 2 / strength[told])))


def combined(p_values: Real) -> float:
    """One p value for several tests that may depend on each other in any way; NaN where none is known.

    References
    ----------
    Y. Liu and J. Xie, "Cauchy combination test: a powerful test with analytic p-value calculation under arbitrary
    dependency structures", J. Am. Stat. Assoc. 115, 2020.
    """
    p = p_values[np.isfinite(p_values)]
    if not len(p):
        return float("nan")
    p = np.clip(p, 1e-300, LARGEST)
    # 1/tan without the loss of digits near 0 that tan(π(1/2 - p)) has
    total = float(np.mean(1.0 / np.tan(np.pi * p)))
    return float(np.arctan2(1.0, total) / np.pi)


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


def clearest(p_values: Real, false_alarm: float, one_at_least: bool = True) -> NDArray[np.bool_]:
    """Which of many quantities move, where it is known that something does, (n_tests,).

    Those that Holm's correction names at this rate; where it names none, the one with the least p value, unless what
    was known to move may not be among them.
    """
    moves = np.nan_to_num(holm(p_values), nan=1.0) < false_alarm
    if one_at_least and np.isfinite(p_values).any():
        moves[int(np.nanargmin(p_values))] = True
    return moves


def _dummies(groups: Integers) -> Real:
    """One column per group."""
    return np.asarray(groups[:, None] == np.unique(groups)[None], dtype=float)


def _centred(values: Real, weight: Real, groups: Integers) -> Real:
    """Values less the weighted mean of their group."""
    means = np.bincount(groups, weight * values) / np.bincount(groups, weight)
    return np.asarray(values - means[groups])
