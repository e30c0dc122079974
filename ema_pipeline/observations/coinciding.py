"""Modes of the model that coincide with a paired one and have no measured partner: the measured shape holds of both.

Of two modes closer than a half-width a test with one reference shows one, whose shape is any mix of the two. So is the
shape of a repeated mode. What the second one can explain is projected out of the differences.

References
----------
L. Kaufman, A variable projection method for solving separable nonlinear least squares problems, BIT 15 (1975) 49-57:
derivatives of what is left without those of the projection.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.eigen_derivatives import EigenSolution
from ema_pipeline.observations.comparison_kernel import nearest_seen

Real = NDArray[np.float64]

_FEWEST_SENSORS = 4
"""Sensors without which two shapes explain nearly any third one."""
_SEEN = 0.1
"""Share of the paired mode's squares from which the sensors see another one: in what was measured as one mode the two
have shares as their residues, and one that hardly moves a sensor explains no wrong shape."""
_EXPLAINED = 0.5
"""Share of a measured shape's squares that two modes must explain together to have been measured as this one."""
_ALONG = 1e-6
"""Share of a shape's weighted squares that it must have of its own beside the paired one."""


def hidden_partners(
    solution: EigenSolution, to: NDArray[np.int64], sensors: NDArray[np.int64], read: Real
) -> NDArray[np.int64]:
    """Nearest mode without a partner that sensors see within a half-width of each paired one, -1 for none, (k,).

    Parameters
    ----------
    solution : EigenSolution
    to : ndarray of int, (k,)
        Modes of the model that have a measured partner.
    sensors : ndarray of int, (k,)
        At how many sensors the shapes of these partners were measured.
    read : ndarray, (s, n)
        What the sensors read of all modes, in their modal scale.
    """
    width = np.nan_to_num(solution.damping_ratio * solution.frequency_hz)
    strength = np.sum(np.abs(read) ** 2, axis=0)
    return np.asarray(
        nearest_seen(solution.frequency_hz, width, to, sensors >= _FEWEST_SENSORS, strength, _SEEN), np.int64
    )


def held_in(
    shapes: Real | NDArray[np.complex128], read: Real, to: NDArray[np.int64], partners: NDArray[np.int64]
) -> NDArray[np.int64]:
    """`hidden_partners`, -1 where the measured shape is no mix of both modes, (k,).

    Parameters
    ----------
    shapes : ndarray, (k, s)
        The measured ones of the paired modes, 0 where not measured.
    read : ndarray, (s, n)
    to, partners : ndarray of int, (k,)
    """
    held = partners.copy()
    for k in np.flatnonzero(partners >= 0):
        both = np.linalg.qr(np.where(shapes[k, :, None] != 0, read[:, [to[k], partners[k]]], 0.0))[0]
        if np.linalg.norm(shapes[k] @ both) ** 2 < _EXPLAINED * np.linalg.norm(shapes[k]) ** 2:
            held[k] = -1
    return held


def directions(
    partners: NDArray[np.int64], predicted: Real, paired: Real, weight: Real
) -> Iterator[tuple[int, Real]]:
    """Place of every shape with a hidden partner, and what that adds to the paired one, (s,), of weighted length 1.

    Parameters
    ----------
    partners : ndarray of int, (k,)
    predicted : ndarray, (s, n)
        What the sensors read of all modes.
    paired : ndarray, (k, s)
        The same of the paired ones.
    weight : ndarray, (k, s)
        One over the variance of each entry; 0 where not measured.
    """
    for k in np.flatnonzero(partners >= 0):
        own, other = paired[k], predicted[:, partners[k]]
        squares = float(weight[k] @ other**2)
        across = other - own * (weight[k] @ (own * other)) / max(float(weight[k] @ own**2), 1e-300)
        left = float(weight[k] @ across**2)
        if left > _ALONG * squares > 0:
            yield int(k), across / np.sqrt(left)
