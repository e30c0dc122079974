"""Several tests of significance at once, and normal tolerance intervals."""

from __future__ import annotations

import numpy as np
import scipy.integrate
import scipy.optimize
import scipy.stats
from numpy.typing import ArrayLike, NDArray


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """p-values adjusted so that the chance of any false finding among all stays below each, (n,); NaN is passed over.

    References
    ----------
    S. Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6 (1979) 65-70.
    """
    p = np.asarray(p_values, float)
    adjusted = np.full(p.shape, np.nan)
    known = np.flatnonzero(np.isfinite(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1.0)
    return adjusted


def tolerance_factor(count: int, content: float, confidence: float, sides: int = 2) -> float:
    """k for which mean ± k·s of a normal sample holds a share `content` of all, with this confidence.

    Parameters
    ----------
    count : int
        Size of the sample, at least 2.
    content, confidence : float
        In (0, 1).
    sides : int
        1 for a limit to one side (mean + k·s), 2 for both.

    Returns
    -------
    float

    References
    ----------
    One-sided: noncentral t distribution, ISO 16269-6:2014, Annex A. Two-sided: A. Wald, J. Wolfowitz, Tolerance limits
    for a normal distribution, Ann. Math. Statist. 17 (1946) 208-215, in the exact form (integral over the sample mean)
    of R. E. Odeh, D. B. Owen, Tables for Normal Tolerance Limits, 1980; the root is looked for around the approximation
    of W. G. Howe, J. Am. Stat. Assoc. 64 (1969) 610-620.
    """
    if sides == 1:
        root = np.sqrt(count)
        away = float(scipy.stats.norm.ppf(content)) * root
        return float(scipy.stats.nct.ppf(confidence, count - 1, away) / root)
    z = float(scipy.stats.norm.ppf((1 + content) / 2))
    howe = z * np.sqrt((count - 1) * (1 + 1 / count) / scipy.stats.chi2.ppf(1 - confidence, count - 1))
    return float(
        scipy.optimize.brentq(
            lambda k: _coverage_chance(k, count, content) - confidence, 0.5 * howe, 2.0 * howe, xtol=1e-8
        )
    )


def _coverage_chance(k: float, count: int, content: float) -> float:
    """Chance that mean ± k·s holds the content, averaged over where the mean falls."""
    freedom = count - 1

    def at(mean: float) -> float:
        half = _half_width(mean / np.sqrt(count), content)
        return float(scipy.stats.chi2.sf(freedom * (half / k) ** 2, freedom) * scipy.stats.norm.pdf(mean))

    return 2 * float(scipy.integrate.quad(at, 0.0, 8.0, epsabs=1e-9, limit=200)[0])


def _half_width(offset: float, content: float) -> float:
    """r for which a standard normal variable lies within offset ± r with the probability `content`."""

    def missing(r: float) -> float:
        return float(scipy.stats.norm.cdf(offset + r) - scipy.stats.norm.cdf(offset - r)) - content

    z = float(scipy.stats.norm.ppf((1 + content) / 2))
    return float(scipy.optimize.brentq(missing, z - 1e-9, z + offset + 1.0, xtol=1e-10))
