"""Sizes of modes in the FRFs of single hits: their residues, which a linear structure has alike at every force.

What a nonlinearity makes shows here first. A spring with a square answers a mode of frequency f at 2f, with a force
that grows with the square of the motion, so that a pole stands there whose residue grows with the force; friction
that locks leaves poles that fade as the force grows. The frequencies of the modes may hardly move meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.levels.single import HitPoles
from ema_pipeline.levels.trend import NO_TREND, Trend

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

PLAIN_DAMPING = 0.01
"""Least change of a damping ratio from the softest to the hardest hits that is claimed, over the ratio. The pulses of
two tips, one ten times as long as the other, change what is read of it by some thousandths."""
PLAIN_SIZE = 0.1
"""Least change from the softest to the hardest hits that is claimed, over the mode's size where it answers most. A
hammer whose reading bends, or a hand that aims otherwise when it strikes harder, changes sizes by some per cent."""


MISREAD = 0.2
"""Change of a mode's pole, in decay rates, that is read of a hit whose size differs from the mean of its sheet by all
of it: aimed otherwise, it shows more of the neighbours."""


def relative_sizes(found: HitPoles) -> tuple[Complex, Real, Real]:
    """Every hit's participation along the mean of its sheet, over the largest mean of any sheet.

    A hit that is aimed otherwise than the others of its sheet changes the real part alone: shapes are nearly real.

    Parameters
    ----------
    found : HitPoles

    Returns
    -------
    values, std : complex and real ndarray, (n_hits, n_modes)
        The standard deviation of either part is ``inf`` where a hit tells nothing.
    mean : ndarray, (n_hits, n_modes)
        What a linear mode would have there: the mean of the hit's sheet, at most 1.

    Notes
    -----
    The mean holds the hit's own noise. That shifts all hits of a sheet by the same amount, since the mean is
    weighted with the noise, and only their differences are looked at.
    """
    mean = means_of_sheets(found.size, found.size_std, found.sheet)
    length = np.abs(mean)
    largest = np.maximum(length.max(axis=0), 1e-300)
    values = found.size * mean.conj() / np.maximum(length, 1e-300) / largest
    known = (length > 0) & np.isfinite(found.size_std)
    return values, np.where(known, found.size_std / largest, np.inf), length / largest


def means_of_sheets(size: Complex, std: Real, sheet: Integers) -> Complex:
    """Weighted mean over every hit's sheet, (n_hits, n_modes); 0 where no hit tells: all ``std`` are ``inf`` there."""
    weight = std**-2.0
    mean = np.zeros_like(size)
    for s in np.unique(sheet):
        of = sheet == s
        total = np.maximum(weight[of].sum(axis=0), 1e-300)
        mean[of] = np.sum(weight[of] * size[of], axis=0) / total
    return mean


def sizes_at_levels(
    values: Real, std: Real, mean: Real, level: Integers, extra_std: float
) -> tuple[Real, Real]:
    """Size of one mode in the hits of each level over that in all hits, and its standard deviation, (n_levels,).

    Parameters
    ----------
    values, std, mean : ndarray, (n_hits,)
        From `relative_sizes`.
    level : ndarray of int, (n_hits,)
    extra_std : float
        Scatter of hits beyond their noise.
    """
    n_levels = int(level.max()) + 1
    size, size_std = np.full((2, n_levels), np.nan)
    for k in range(n_levels):
        of = (level == k) & np.isfinite(std)
        weight = 1.0 / (std[of] ** 2 + extra_std**2)
        strength = float(np.sum(weight * mean[of] ** 2))
        if strength > 0:
            size[k] = float(np.sum(weight * mean[of] * values[of])) / strength
            size_std[k] = strength**-0.5
    return size, size_std


def plain(trend: Trend, size: Real) -> Trend:
    """The test's result, without significance where the size changes by too little to tell of the structure."""
    known = size[np.isfinite(size)]
    return trend if known.size and np.ptp(known) >= PLAIN_SIZE else unknown(trend)


def plain_damping(trend: Trend, damping_ratio: float, log_force: Real) -> Trend:
    """The same where a damping ratio changes by too little over all forces, given as ln(force), (n_hits,)."""
    return trend if abs(trend.slope) * np.ptp(log_force) >= PLAIN_DAMPING * damping_ratio else unknown(trend)


def not_of_aim(trend: Trend, quadrature: Trend, elsewhere: Sequence[Trend]) -> Trend:
    """The test's result, where aim cannot have caused it.

    Hits that are aimed otherwise at one level change the real part of sizes at one point. So either the imaginary part
    has to change as well, or the real part without any one of the points.

    Parameters
    ----------
    trend, quadrature : Trend
        Of the real and the imaginary part.
    elsewhere : sequence of Trend
        Of the real part without each sheet in turn.
    """
    others = max((t.p if np.isfinite(t.p) else 1.0 for t in elsewhere), default=trend.p)
    least = trend.p if len(elsewhere) < 2 else min(quadrature.p, others)
    return Trend(max(trend.p, least), trend.slope, trend.extra_std)


def unknown(trend: Trend) -> Trend:
    """The test's result without significance."""
    return Trend(NO_TREND if np.isfinite(trend.p) else trend.p, trend.slope, trend.extra_std)
