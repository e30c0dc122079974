"""What measured modes cost that no mode of the model is, and modes of the model in the band that were not measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.inference import tails
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.observations.mode_rows import (
    FREQUENCY,
    FREQUENCY_NOISE,
    SHAPE,
    SHAPE_NOISE,
    UNEVEN_DAMPING,
    shape_unit,
)
from ema_pipeline.observations.parts import DAMPING_SCATTER

UNEXPLAINED = 18.0
"""Cost, in the log posterior, of a measured mode without a model mode: of some 1,400 that were identified in studies of
simulated tests none was invented."""
UNEXPLAINED_SENSOR, _MOST_SENSORS = 2.0, 5
"""What every sensor beyond two adds to that, up to so many: its entry agrees with that of a wrong partner by chance
only. An explained mode pays about as much for what it tells of calibration and parts."""
UNEXPLAINED_DOUBLE = 12.0
"""The same of one whose shape is a mix of its neighbours': drift may have split it off."""
UNEXPLAINED_PRODUCT = 5.0
"""The same of one at a multiple or sum of others' frequencies, in tests at several force levels: of some 340 modes in
24 of them, two that passed were third and second harmonics."""
UNSEEN = 3.0
"""Cost of a model mode in the band that was not measured: it may lie on a node of every sensor or hit point."""
_READ = 0.01
"""Least motion at some sensor, over the largest one of a mode there, from which a mode would have been measured.
Sensors along y alone read nothing of modes along x."""

_SCATTERS = (FREQUENCY, FREQUENCY_NOISE, SHAPE, SHAPE_NOISE, UNEVEN_DAMPING, DAMPING_SCATTER)
_KEPT = 64
"""Costs that are kept."""


@dataclass(frozen=True)
class Alone:
    """Measured modes without a partner.

    Attributes
    ----------
    unexplained : int
        Number of those of which there is no doubt.
    split : float
        Cost of the others: doubles, and what a nonlinearity may have made.
    penalty : float
        Cost of all of them beyond what they would cost on average if they were explained.
    usual : float
        That average. Without it, leaving a mode out would gain what its rows cost, and no effect would ever bring it
        back.
    """

    unexplained: int = 0
    split: float = 0.0
    penalty: float = 0.0
    usual: float = 0.0

    @classmethod
    def of(
        cls,
        data: ModeData,
        alone: NDArray[np.int64],
        scatters: Mapping[str, float],
        defaults: Mapping[str, float],
    ) -> Alone:
        """From their numbers among the measured modes, (k,), and the scatters as they are tried and stated.

        They stay the same from step to step of a fit: what was calculated last is kept with the data.
        """
        if not len(alone):
            return cls()
        key = alone.tobytes(), *(at.get(name) for at in (scatters, defaults) for name in _SCATTERS)
        known = data.costs_alone
        if key not in known:
            if len(known) >= _KEPT:
                known.clear()
            sure = alone[~data.doubtful[alone]]
            doubles = int(np.sum(data.double[alone]))
            split = UNEXPLAINED_DOUBLE * doubles + UNEXPLAINED_PRODUCT * (len(alone) - len(sure) - doubles)
            further = np.clip(np.sum(np.isfinite(data.shapes[sure]), axis=1) - 2, 0, _MOST_SENSORS)
            penalty = UNEXPLAINED * len(sure) + UNEXPLAINED_SENSOR * float(np.sum(further)) + split
            penalty += _credited(data, sure, scatters, defaults)
            known[key] = cls(len(sure), split, penalty, _usual(data, alone, scatters, defaults))
        return known[key]


def unseen(
    data: ModeData,
    frequency_hz: NDArray[np.float64],
    accounted: NDArray[np.int64],
    read: NDArray[np.float64],
) -> float:
    """Cost of model modes well inside the band, without those that are paired, or hidden in one that is.

    Parameters
    ----------
    data : ModeData
    frequency_hz : ndarray, (n,)
        Of the model's modes.
    accounted : ndarray of int, (k,)
        Those that are paired or hidden.
    read : ndarray, (s, n)
        What the sensors read of mass-normalised shapes along their own directions; s may be 0.
    """
    if not data.complete:
        return 0.0
    low, high = data.band_hz
    inside = (frequency_hz > 1.05 * low) & (frequency_hz < 0.95 * high)
    inside[accounted] = False
    if len(read):
        size = np.abs(read)
        inside &= np.any(size > _READ * np.max(size, axis=1, keepdims=True), axis=0)
    return UNSEEN * int(np.count_nonzero(inside))


def _usual(
    d: ModeData, alone: NDArray[np.int64], scatters: Mapping[str, float], defaults: Mapping[str, float]
) -> float:
    """What modes would cost on average if they were explained."""
    seen, whirl = np.isfinite(d.shapes[alone]), d.whirling[alone]
    real, both, lag = seen & ~whirl[:, None], seen & whirl[:, None], seen & d.lagging[alone, None]
    reach = shape_unit(d.compared_shapes[alone])
    std, broad = d.compared_std[alone], d.broad_std[alone, None] + np.zeros(seen.shape)
    damped = alone[np.isfinite(d.log_damping[alone])]
    parts = 1 + whirl  # real and imaginary
    total = -0.5 * float(np.sum(parts[np.any(seen, axis=1)]) + np.sum(np.any(lag, axis=1)))
    for count in (np.sum(seen, axis=1, dtype=float) * parts, np.sum(lag, axis=1, dtype=float)):
        total += float(np.sum(tails.cost(count, count) - 0.5 * count))
    none, one = np.zeros(1), np.ones(1)
    for own, least, unit, name, noise in (
        (d.log_frequency_std[alone], none, one, FREQUENCY, FREQUENCY_NOISE),
        (d.log_damping_std[damped], none, one, DAMPING_SCATTER, ""),
        (std[real], broad[real], reach[real], SHAPE, SHAPE_NOISE),
        (std[lag], d.lag_std[alone][lag], d.lag_unit[alone][lag], UNEVEN_DAMPING, SHAPE_NOISE),
        (np.tile(std[both], 2), np.tile(broad[both], 2), np.tile(reach[both], 2), SHAPE, ""),
    ):
        now, usual = (
            (at.get(noise, 1.0) * own) ** 2 + least**2 + (at[name] * unit) ** 2 for at in (scatters, defaults)
        )
        total += 0.5 * float(np.sum(np.log(now / usual) + 1.0))
    return total


def _credited(
    d: ModeData, sure: NDArray[np.int64], scatters: Mapping[str, float], defaults: Mapping[str, float]
) -> float:
    """What `_usual` credits modes with because the shapes of others agree better than usual.

    Those that are hard to find a partner for are close ones, whose shapes are seldom as good.
    """
    now, usual = (
        (at[SHAPE_NOISE] * d.compared_std[sure]) ** 2
        + d.broad_std[sure, None] ** 2
        + (at[SHAPE] * shape_unit(d.compared_shapes[sure])) ** 2
        for at in (scatters, defaults)
    )
    return float(np.sum(np.maximum(0.5 * np.log(usual / now), 0.0)[np.isfinite(d.shapes[sure])]))
