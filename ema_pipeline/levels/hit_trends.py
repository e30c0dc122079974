"""All quantities of all modes, as single hits show them, tested for a trend with the force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.levels.common_drift import common_drift
from ema_pipeline.levels.single import HitPoles, excitation
from ema_pipeline.levels.sizes import (
    MISREAD,
    not_of_aim,
    plain,
    plain_damping,
    relative_sizes,
    sizes_at_levels,
    unknown,
)
from ema_pipeline.levels.trend import Samples, Trend, combined, samples, scattered_by_sheet, trends

Real = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class HitTrends:
    """Trends of every mode, (n_modes,) each.

    Attributes
    ----------
    frequency, damping, size : tuple of Trend
    level_sizes : tuple of (ndarray, ndarray)
        Size at every level over that in all hits, and its standard deviation, (n_levels,).
    """

    frequency: tuple[Trend, ...]
    damping: tuple[Trend, ...]
    size: tuple[Trend, ...]
    level_sizes: tuple[tuple[Real, Real], ...]

    @property
    def p_values(self) -> Real:
        """Frequencies, dampings and sizes in turn, (3·n_modes,)."""
        return np.array([t.p for t in (*self.frequency, *self.damping, *self.size)])

    @property
    def p_value(self) -> float:
        """Of all together."""
        return combined(self.p_values)


def hit_trends(found: HitPoles, level: Integers, far: NDArray[np.bool_]) -> HitTrends:
    """Test frequency, damping and size of every mode.

    Parameters
    ----------
    found : HitPoles
    level : ndarray of int, (n_hits,)
        Force level of each hit.
    far : ndarray of bool, (n_modes,)
        Modes whose poles go so far that differences between hits do not tell their sizes.
    """
    n_modes = found.frequency_hz.shape[1]
    relative = excitation(found)

    def given(values: Real, stds: Real) -> list[Samples]:
        return [
            samples(values[:, r], stds[:, r], found.sheet, level, found.force_n, relative[:, r])
            for r in range(n_modes)
        ]

    values, std, mean = relative_sizes(found)
    misread = MISREAD * np.abs(values.real - mean) / np.maximum(mean, 1e-300)
    decay = np.median(found.damping_ratio, axis=0)
    drift = common_drift(found.frequency_hz, found.frequency_std_hz, found.sheet)
    poles = trends(
        given(
            found.frequency_hz * np.exp(-drift)[:, None],
            np.hypot(found.frequency_std_hz, misread * decay * found.frequency_hz),
        )
        + given(found.damping_ratio, np.hypot(found.damping_std, misread * decay))
    )

    def of_sizes(part: Real, std: Real) -> tuple[Trend, ...]:
        # by themselves: an unsteady hand scatters sizes more than poles, most where oblique hits alone excite
        return trends([scattered_by_sheet(s) for s in given(part, std)])

    sizes, quadratures = of_sizes(values.real, std), of_sizes(values.imag, std)
    elsewhere = [
        of_sizes(values.real, np.where((found.sheet == s)[:, None], np.inf, std))
        for s in np.unique(found.sheet)
    ]
    at_levels = tuple(
        sizes_at_levels(values.real[:, r], std[:, r], mean[:, r], level, test.extra_std)
        for r, test in enumerate(sizes)
    )
    told = tuple(
        unknown(test) if gone else plain(not_of_aim(test, turned, others), size)
        for test, turned, others, (size, _), gone in zip(
            sizes, quadratures, zip(*elsewhere, strict=True), at_levels, far, strict=True
        )
    )
    log_force = np.log(found.force_n)
    damping = tuple(plain_damping(t, d, log_force) for t, d in zip(poles[n_modes:], decay, strict=True))
    return HitTrends(poles[:n_modes], damping, told, at_levels)
