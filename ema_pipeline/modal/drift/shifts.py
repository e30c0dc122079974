"""One factor per hit, common to all modes, and what single modes move beyond it: a mixed model.

The frequency of peak c in hit h on point p, relative to its own mean, is taken as

    e_hc = Σ_i s_hci m_ci + b t_h + g_p + d_h + k_pc + x_hc + noise ,

m_ci the mean of mode i of those that make the peak, s_hci the share with which the hit shows it, 1 where one makes it;
b t_h + g_p + d_h what all peaks have in common: a trend over the order t_h of the hits, as where a rig warms up; g_p
alike in all hits of a point, for a rig drifts while the hammer moves from point to point; d_h of the hit alone. k_pc is
what the peak shows alike in all hits of a point, x_hc its own movement.
k_pc is mostly no movement but a second mode under the peak, or the flank of a stronger one, which another point
excites in another ratio: it grows as the peak itself gets weaker, and so may x_hc. The variances of g, d, k and x
are estimated with them (expectation-maximisation).

References
----------
Laird, N. M. & Ware, J. H., "Random-effects models for longitudinal data", Biometrics 38, 1982.
Satterthwaite, F. E., "An approximate distribution of estimates of variance components", Biometrics Bulletin 2, 1946.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtri, stdtrit

from ema_pipeline.modal.serial import widening

Real = NDArray[np.float64]

ITERATIONS = 80

COVERED = 0.95
"""Quantile at which the intervals of a mean of few values are to hold as those of many."""

TAIL = 4.0
"""Degrees of freedom of the t distribution that stands for errors: single hits may be far off."""

FEWEST_FOR_TREND = 3
"""Hits without which no trend is told from scatter."""

JUMP_P = 0.1
"""p value above which two points differ by no more than a line explains."""

SHOWN = 0.05
"""Least ratio of the information that two points give of a peak that both of them show."""

STEP = 0.1
"""Relative change of a variance by which is seen what depends on it."""

FLOOR = 1e-12
"""Least variance of a relative frequency."""


@dataclass(frozen=True)
class CommonError:
    """How well the common movement is known.

    Attributes
    ----------
    covariance : ndarray, (n_hits, n_hits)
        Of the common movement in the hits, given the variances: its mean over hits, which frequencies at rest are
        told from, included.
    slopes : tuple of ndarray, (n_hits, n_hits)
        How the covariance grows with the variances of single hits and of points, relative to them.
    degrees : tuple of float
        Degrees of freedom from which these two are known.
    widening : tuple of float
        How much these two widen: hits and points that follow one another may have moved alike.
    """

    covariance: Real
    slopes: tuple[Real, Real]
    degrees: tuple[float, float]
    widening: tuple[float, float]

    def mean_std(self, share: Real) -> float:
        """Standard deviation that the common movement leaves in a weighted mean over hits.

        It is widened so that normal intervals hold though its variances are known from few hits and points.

        Parameters
        ----------
        share : ndarray, (n_hits,)
            Weights, sum 1: where few hits or points show a mode, it is their movement that counts.
        """
        parts = [float(share @ slope @ share) for slope in self.slopes]
        variance = float(share @ self.covariance @ share)
        variance += sum(part * (wide**2 - 1) for part, wide in zip(parts, self.widening, strict=True))
        if not variance > 0:
            return 0.0
        parts = [part * wide**2 for part, wide in zip(parts, self.widening, strict=True)]
        uncertainty = sum(part**2 / free for part, free in zip(parts, self.degrees, strict=True))
        free = variance**2 / max(uncertainty, 1e-9 * variance**2)
        return float(np.sqrt(variance) * wider(max(free, 1.0)))


@dataclass(frozen=True)
class Movement:
    """What moves from hit to hit, relative to the mean over hits.

    Attributes
    ----------
    common, common_std : ndarray, (n_hits,)
        Factor b t + g + d of every hit, g and d shrunk towards 0 by their own variances.
    spread : float
        Standard deviation of b t + g + d.
    error : CommonError
        How well it is known.
    own : ndarray, (n_hits, n_peaks)
        Movement x of single peaks beyond it, shrunk; 0 where a hit does not show the peak.
    own_spread : ndarray, (n_peaks,)
        Standard deviation of x.
    point_spread : ndarray, (n_peaks,)
        Standard deviation of k; 0 where no point was hit twice.
    """

    common: Real
    common_std: Real
    spread: float
    error: CommonError
    own: Real
    own_spread: Real
    point_spread: Real

    @property
    def mean_std(self) -> float:
        """Standard deviation that it leaves in a mean over all hits."""
        return self.error.mean_std(np.full(len(self.common), 1 / len(self.common)))


@dataclass(frozen=True)
class _Posterior:
    mean: Real
    covariance: Real
    fitted: Real
    fitted_variance: Real

    @property
    def variance(self) -> Real:
        return np.diag(self.covariance)


def movement(
    shift: Real, std: Real, strength: Real, point: NDArray[np.int64], shares: Sequence[Real] = ()
) -> Movement:
    """Estimate what moves.

    Parameters
    ----------
    shift, std : ndarray, (n_hits, n_peaks)
        Relative frequency of every peak in every hit; std ``inf`` where a hit does not show the peak.
        Hits in the order in which they came.
    strength : ndarray, (n_hits, n_peaks)
        Size of the peak in the hit over its median.
    point : ndarray of int, (n_hits,)
    shares : sequence of ndarray, (n_hits, n_modes)
        Of the modes that make each peak; one mode each where left out.
    """
    n_hits, n_peaks = shift.shape
    shares = shares or [np.ones((n_hits, 1))] * n_peaks
    n_means = sum(share.shape[1] for share in shares)
    known = np.isfinite(std)
    repeated = np.bincount(point, minlength=int(point.max()) + 1)[point] > 1
    struck, of_points = np.unique(point), np.unique(point[repeated])
    # At one point g would be the mean of all peaks; two differ by what a line explains, too.
    two = len(struck) == len(of_points) == 2
    if len(struck) < 2 or (two and _explained_by_a_line(shift, std, point)):
        of_points = of_points[:0]
    design, groups, shared = _design(known, point, repeated, of_points, shares)
    n_trend, n_points = shared.trend.shape[1], shared.of_point.shape[1]
    hit, peak = np.nonzero(known)
    value = shift[hit, peak]
    noise = std[hit, peak] ** 2
    weak = 1.0 / np.clip(strength[hit, peak], 1e-2, 3.0) ** 2
    start = np.array([_robust_variance(value[peak == c]) for c in range(n_peaks)])
    common = float(np.median(start[start > 0])) if np.any(start > 0) else FLOOR
    moving = common
    own, per_point = 0.5 * start + FLOOR, 0.5 * start + FLOOR
    tail = np.ones(len(value))
    slope = slice(n_means, n_means + n_trend)
    hits = slice(slope.stop, slope.stop + n_hits)
    points = slice(hits.stop, hits.stop + n_points)

    def solved(common: float, moving: float) -> _Posterior:
        of_common = (np.full(n_hits, common), np.full(n_points, moving))
        prior = np.concatenate([np.full(n_means + n_trend, np.inf), *of_common, per_point[groups]])
        return _posterior(design, value, error, prior)

    for _ in range(ITERATIONS):
        error = (noise + own[peak] * weak) / tail
        found = solved(common, moving)
        left = value - found.fitted
        square = left**2 + found.fitted_variance
        tail = (TAIL + 1) / (TAIL + square / (error * tail))
        common = _variance(found, hits)
        if n_points:
            moving = _variance(found, points)
        for c in range(n_peaks):
            mine = points.stop + np.flatnonzero(groups == c)
            if len(mine):
                per_point[c] = max(float(np.mean(found.mean[mine] ** 2 + found.variance[mine])), FLOOR)
            own[c] = _own_variance(
                own[c], square[peak == c], noise[peak == c], weak[peak == c], tail[peak == c]
            )
    single = np.zeros(shift.shape)
    # What a weak peak seems to move beyond what a strong one does is the flank of another: no movement to undo.
    spread = own[peak] * np.minimum(weak, 1.0)
    single[hit, peak] = (value - found.fitted) * spread / (own[peak] * weak + noise)
    read = np.hstack([shared.trend, np.eye(n_hits), shared.of_point])
    both = slice(n_means, points.stop)

    def covariance(found: _Posterior) -> Real:
        return np.asarray(read @ found.covariance[both, both] @ read.T)

    found = solved(common, moving)
    factor, known_to = read @ found.mean[both], covariance(found)
    slopes = [
        (covariance(solved(*more)) - known_to) / STEP
        for more in ((common * (1 + STEP), moving), (common, moving * (1 + STEP)))
    ]
    trend = shared.trend @ found.mean[slope]
    at_points = shared.of_point.T @ trend / np.maximum(shared.of_point.sum(axis=0), 1.0)
    between = max(n_points - 1, 1)
    degrees = (max(n_hits - 1 - n_trend - (between if n_points else 0), 1), between)
    # what peaks move by themselves, x and k, takes its share of what few hits and points show of d and g
    few = [np.sqrt((free + 1) / free) for free in degrees]
    alike = (
        few[0] * widening(trend + found.mean[hits]),
        few[1] * widening(at_points + found.mean[points]) if n_points else 1.0,
    )
    return Movement(
        common=factor,
        common_std=np.sqrt(np.diag(known_to)),
        spread=float(np.sqrt(common + (moving if n_points else 0.0) + np.sum(found.mean[slope] ** 2))),
        error=CommonError(known_to, (slopes[0], slopes[1]), degrees, alike),
        own=single,
        own_spread=np.sqrt(own),
        point_spread=np.sqrt(np.where(np.isin(np.arange(n_peaks), groups), per_point, 0.0)),
    )


@dataclass(frozen=True)
class _Shared:
    """Of all peaks: the trend over hits, (n_hits, 0 or 1), and which hits share each g, (n_hits, n_g)."""

    trend: Real
    of_point: Real


def _design(
    known: NDArray[np.bool_],
    point: NDArray[np.int64],
    repeated: NDArray[np.bool_],
    moved: NDArray[np.int64],
    shares: Sequence[Real],
) -> tuple[Real, NDArray[np.int64], _Shared]:
    """Columns of m, b, d, g and k for every value, the peak of each k, and what b and g multiply."""
    n_hits = len(known)
    hit, peak = np.nonzero(known)
    of_point = (point[:, None] == moved).astype(float)
    pairs = sorted({(int(point[h]), int(c)) for h, c in zip(hit, peak, strict=True) if repeated[h]})
    place = {pair: k for k, pair in enumerate(pairs)}
    order = np.arange(n_hits, dtype=np.float64) - 0.5 * (n_hits - 1)
    trend = (order / max(float(np.std(order)), 1.0))[:, None]
    if n_hits < FEWEST_FOR_TREND:
        trend = trend[:, :0]
    means = np.hstack([np.where((peak == c)[:, None], share[hit], 0.0) for c, share in enumerate(shares)])
    first = means.shape[1] + trend.shape[1]
    before = first + n_hits
    design = np.zeros((len(hit), before + len(moved) + len(pairs)))
    design[:, :first] = np.hstack([means, trend[hit]])
    design[np.arange(len(hit)), first + hit] = 1.0
    design[:, before : before + len(moved)] = of_point[hit]
    for k, (h, c) in enumerate(zip(hit, peak, strict=True)):
        if repeated[h]:
            design[k, before + len(moved) + place[int(point[h]), int(c)]] = 1.0
    return design, np.array([c for _, c in pairs], dtype=np.int64), _Shared(trend, of_point)


def _explained_by_a_line(shift: Real, std: Real, point: NDArray[np.int64]) -> bool:
    """True where a line over the hits leaves two points with no difference that an F test would see.

    Line and difference are nearly the same there: beside each other, neither variance is known. False where no peak
    shows on both points.
    """
    first = point == point[0]
    weight = 1 / std**2
    here, there = weight[first].mean(axis=0), weight[~first].mean(axis=0)
    weight = weight * (np.minimum(here, there) > SHOWN * np.maximum(here, there))
    seen = weight.sum(axis=1) > 0
    free = int(np.sum(seen)) - 3
    if free < 1 or not (np.any(seen & first) and np.any(seen & ~first)):
        return False
    common = (np.sum(weight * shift, axis=1) / np.maximum(weight.sum(axis=1), 1e-300))[seen]
    order = np.flatnonzero(seen).astype(float)
    columns = np.stack([np.ones(len(order)), order - order.mean(), first[seen]], axis=1)
    left = [
        np.sum((common - c @ np.linalg.lstsq(c, common, rcond=None)[0]) ** 2)
        for c in (columns[:, :2], columns)
    ]
    return bool(fdtrc(1, free, (left[0] - left[1]) / max(left[1] / free, 1e-300)) > JUMP_P)


def _variance(found: _Posterior, of: slice) -> float:
    """Expected mean square of some of the unknowns."""
    return max(float(np.mean(found.mean[of] ** 2 + found.variance[of])), FLOOR)


def _posterior(design: Real, value: Real, error: Real, prior: Real) -> _Posterior:
    """Mean and variance of the unknowns, and of what they add up to for each value."""
    scaled = design / error[:, None]
    precision = design.T @ scaled + np.diag(np.where(np.isfinite(prior), 1.0 / prior, 1e-6))
    scale = 1.0 / np.sqrt(np.diag(precision))
    covariance = np.linalg.inv(precision * scale[:, None] * scale) * scale[:, None] * scale
    mean = covariance @ (scaled.T @ value)
    return _Posterior(mean, covariance, design @ mean, np.einsum("ka,ab,kb->k", design, covariance, design))


def _own_variance(old: float, square: Real, noise: Real, weak: Real, tail: Real) -> float:
    """Next estimate of the variance of x from the squares that are left of one peak."""
    if not len(square):
        return old
    total = noise / weak + old
    ratio = float(np.mean(tail * square / weak / total**2) / np.mean(1.0 / total))
    return max(old * np.sqrt(ratio), FLOOR)


def wider(degrees: float) -> float:
    """How much wider than a normal interval one is whose standard deviation has few degrees of freedom."""
    return float(stdtrit(degrees, COVERED) / ndtri(COVERED))


def _robust_variance(values: Real) -> float:
    """Variance from the median absolute deviation."""
    if len(values) < 2:
        return 0.0
    return float((1.4826 * np.median(np.abs(values - np.median(values)))) ** 2)
