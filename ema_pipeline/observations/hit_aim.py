"""How every hit was aimed, from the motion that it left.

A hit some degrees off moves modes that one along the stated direction would leave alone, and friction acts on all of
them at once. So hits are marched from the motion that was measured just after them. Where it says nothing of a mode,
the direction that explains the others is taken: what is struck moves at once, and nothing else does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.observations.hit_data import HitData

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]

_AIM_STD, _GAIN_STD = 0.14, 0.05
"""1 σ of a blow's share across its direction (8°), and of the gain of hammer and sensors."""
_MOTION_STD = 0.1
"""1 σ of a mode's measured motion, over what a hit that far off would make of it."""
_ROUNDS, _TAIL = 5, 2.0
"""Rounds of the fit in which modes count less that are off by more than so many σ: some hardly ring."""
_NEAR = 0.5
"""Relative difference from the direction found, up to which a mode's own measured motion is believed. Motions that do
not go together would let what was not struck jump, and friction with it."""


def as_aimed(
    data: HitData, nominal: Real, across: list[Real], displacement: Complex, match: Integers, scale: float
) -> Complex:
    """Motion of each hit's point along the blow in each shape, as the measured motion tells it, (h, n).

    Parameters
    ----------
    data : HitData
        With `pulses`.
    nominal : ndarray, (h, n)
        The same along the stated direction.
    across : list of ndarray, (k, n)
        The same in directions across it, of each hit; k may be 0.
    displacement : complex ndarray, (h, m)
        Amplitude of each modal coordinate just after the blow, as measured.
    match : ndarray of int, (m,)
        Mode of the model that each hit mode is; -1 for none.
    scale : float
        Factor on all forces.
    """
    found = nominal.astype(complex)
    on = np.flatnonzero(match >= 0)
    to, measured = match[on], displacement[:, on] / (scale * _per_unit(data, on))
    for h, rows in enumerate(across):
        told = data.used[h, on] & (displacement[h, on] != 0)
        if not told.any():
            continue
        along = nominal[h, to[told]]
        others = rows[:, to[told]]
        share = _shares(along, others, measured[h, told].real)
        aimed = (1 + share[0]) * nominal[h] + share[1:] @ rows
        found[h] = aimed
        now = aimed[to[told]]
        near = np.abs(measured[h, told] - now) < _NEAR * np.abs(now)
        found[h, to[told][near]] = measured[h, told][near]
    return found


def _per_unit(data: HitData, on: Integers) -> Complex:
    """Displacement that each hit's blow makes of modes whose shape is 1 where it strikes, (h, k)."""
    pulses = data.pulses
    assert pulses is not None
    time = (np.arange(pulses.force_n.shape[1]) - pulses.peak) / pulses.sample_rate_hz
    poles = data.ringing.exponents[on]
    impulse = pulses.force_n @ np.exp(-time[:, None] * poles) / pulses.sample_rate_hz
    return np.asarray(-1j / data.omega[on] * impulse, np.complex128)


def _shares(along: Real, others: Real, measured: Real) -> Real:
    """Gain less 1, and share of every direction across, that explain a hit's measured motion best, (1 + k,)."""
    columns = np.concatenate([along[None], others])
    prior = np.array([_GAIN_STD, *[_AIM_STD] * len(others)])
    std = _MOTION_STD * (np.abs(along) + _AIM_STD * np.abs(others).sum(axis=0)) + 1e-300
    columns, left = columns / std, (measured - along) / std
    weight = np.ones(len(left))
    share = np.zeros(len(columns))
    for _ in range(_ROUNDS):
        normal = (columns * weight) @ columns.T + np.diag(prior**-2.0)
        share = np.linalg.solve(normal, columns @ (weight * left))
        weight = 1 / (1 + ((left - share @ columns) / _TAIL) ** 2)
    return np.asarray(share)
