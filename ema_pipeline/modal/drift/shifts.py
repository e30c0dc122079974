"""One factor per hit, common to all modes, and what single modes move beyond it: a mixed model.

The frequency of peak c in hit h on point p, relative to its own mean, is taken as

    e_hc = m_c + g_p + d_h + k_pc + x_hc + noise ,

g_p + d_h what all peaks have in common, g_p alike in all hits of a point, for a rig drifts while the hammer moves from
point to point; k_pc what the peak shows alike in all hits of a point, x_hc its own movement.
k_pc is mostly no movement but a second mode under the peak, or the flank of a stronger one, which another point
excites in another ratio: it grows as the peak itself gets weaker, and so may x_hc. The variances of g, d, k and x
are estimated with them (expectation-maximisation).

References
----------
Laird, N. M. & Ware, J. H., "Random-effects models for longitudinal data", Biometrics 38, 1982.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from ema_pipeline.modal.serial import widening

Real = NDArray[np.float64]

ITERATIONS = 80

COVERED = 0.95
"""Quantile at which the intervals of a mean of few values are to hold as those of many."""

TAIL = 4.0
"""Degrees of freedom of the t distribution that stands for errors: single hits may be far off."""

FLOOR = 1e-12
"""Least variance of a relative frequency."""


@dataclass(frozen=True)
class Movement:
    """What moves from hit to hit, relative to the mean over hits.

    Attributes
    ----------
    common, common_std : ndarray, (n_hits,)
        Factor g + d of every hit, shrunk towards 0 by its own variance.
    spread : float
        Standard deviation of g + d.
    mean_std : float
        Standard deviation of the mean of g + d over hits, widened so that normal intervals of a mean of few hits and
        points hold.
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
    mean_std: float
    own: Real
    own_spread: Real
    point_spread: Real


@dataclass(frozen=True)
class _Posterior:
    mean: Real
    variance: Real
    fitted: Real
    fitted_variance: Real


def movement(shift: Real, std: Real, strength: Real, point: NDArray[np.int64]) -> Movement:
    """Estimate what moves.

    Parameters
    ----------
    shift, std : ndarray, (n_hits, n_peaks)
        Relative frequency of every peak in every hit; std ``inf`` where a hit does not show the peak.
    strength : ndarray, (n_hits, n_peaks)
        Size of the peak in the hit over its median.
    point : ndarray of int, (n_hits,)
    """
    n_hits, n_peaks = shift.shape
    known = np.isfinite(std)
    repeated = np.bincount(point, minlength=int(point.max()) + 1)[point] > 1
    design, groups, of_point = _design(known, point, repeated)
    n_points = of_point.shape[1]
    hit, peak = np.nonzero(known)
    value = shift[hit, peak]
    noise = std[hit, peak] ** 2
    weak = 1.0 / np.clip(strength[hit, peak], 1e-2, 3.0) ** 2
    start = np.array([_robust_variance(value[peak == c]) for c in range(n_peaks)])
    common = float(np.median(start[start > 0])) if np.any(start > 0) else FLOOR
    moving = common
    own, per_point = 0.5 * start + FLOOR, 0.5 * start + FLOOR
    tail = np.ones(len(value))
    hits = slice(n_peaks, n_peaks + n_hits)
    points = slice(hits.stop, hits.stop + n_points)
    for _ in range(ITERATIONS):
        error = (noise + own[peak] * weak) / tail
        prior = np.concatenate(
            [np.full(n_peaks, np.inf), np.full(n_hits, common), np.full(n_points, moving), per_point[groups]]
        )
        found = _posterior(design, value, error, prior)
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
    return Movement(
        common=found.mean[hits] + of_point @ found.mean[points],
        common_std=np.sqrt(found.variance[hits] + of_point @ found.variance[points]),
        spread=float(np.sqrt(common + (moving if n_points else 0.0))),
        mean_std=_mean_std(
            (np.sqrt(common), found.mean[hits], np.full(n_hits, 1 / n_hits)),
            (np.sqrt(moving), found.mean[points], of_point.sum(axis=0) / n_hits),
        ),
        own=single,
        own_spread=np.sqrt(own),
        point_spread=np.sqrt(np.where(np.isin(np.arange(n_peaks), groups), per_point, 0.0)),
    )


def _design(
    known: NDArray[np.bool_], point: NDArray[np.int64], repeated: NDArray[np.bool_]
) -> tuple[Real, NDArray[np.int64], Real]:
    """Columns of m, d, g and k for every value, the peak of each k, and which hits share each g, (n_hits, n_g)."""
    n_hits, n_peaks = known.shape
    hit, peak = np.nonzero(known)
    # At one point g would be the mean of all peaks.
    moved = np.unique(point[repeated]) if len(np.unique(point)) > 1 else np.zeros(0, int)
    of_point = (point[:, None] == moved).astype(float)
    pairs = sorted({(int(point[h]), int(c)) for h, c in zip(hit, peak, strict=True) if repeated[h]})
    place = {pair: k for k, pair in enumerate(pairs)}
    before = n_peaks + n_hits
    design = np.zeros((len(hit), before + len(moved) + len(pairs)))
    row = np.arange(len(hit))
    design[row, peak] = 1.0
    design[row, n_peaks + hit] = 1.0
    design[:, before : before + len(moved)] = of_point[hit]
    for k, (h, c) in enumerate(zip(hit, peak, strict=True)):
        if repeated[h]:
            design[k, before + len(moved) + place[int(point[h]), int(c)]] = 1.0
    return design, np.array([c for _, c in pairs], dtype=np.int64), of_point


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
    return _Posterior(
        mean, np.diag(covariance), design @ mean, np.einsum("ka,ab,kb->k", design, covariance, design)
    )


def _own_variance(old: float, square: Real, noise: Real, weak: Real, tail: Real) -> float:
    """Next estimate of the variance of x from the squares that are left of one peak."""
    if not len(square):
        return old
    total = noise / weak + old
    ratio = float(np.mean(tail * square / weak / total**2) / np.mean(1.0 / total))
    return max(old * np.sqrt(ratio), FLOOR)


def _mean_std(*parts: tuple[float, Real, Real]) -> float:
    """Standard deviation of a mean of parts, each with its spread, its values in order and their weights in the mean.

    Where hits of few points share most of the movement, there are as many independent values as points.
    """
    variance, uncertainty = 0.0, 0.0
    for spread, values, weights in parts:
        if len(values):
            free = max(len(values) - 1, 1)
            # the spread is one of maximum likelihood, which leaves out that the mean was estimated too
            part = spread**2 * float(np.sum(weights**2)) * widening(values) ** 2 * len(values) / free
            variance, uncertainty = variance + part, uncertainty + part**2 / free
    if not variance > 0:
        return 0.0
    return float(np.sqrt(variance) * wider(variance**2 / uncertainty))


def wider(degrees: float) -> float:
    """How much wider than a normal interval one is whose standard deviation has few degrees of freedom."""
    return float(stdtrit(degrees, COVERED) / ndtri(COVERED))


def _robust_variance(values: Real) -> float:
    """Variance from the median absolute deviation."""
    if len(values) < 2:
        return 0.0
    return float((1.4826 * np.median(np.abs(values - np.median(values)))) ** 2)
