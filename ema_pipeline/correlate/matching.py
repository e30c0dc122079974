"""Modes of two tests of like structures: which of one is which of the other."""

from __future__ import annotations

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.modal.assurance import mac

REACH = 0.1
"""Difference of ln f that counts as much as shapes that have nothing in common."""
REACH_ALONE = 0.05
"""The same where no shapes can be compared: a larger change than this is no match."""
LEAST_MAC = 0.5
"""MAC below which two shapes are not those of one mode."""
_FARTHEST = 0.35
"""Difference of ln f above which two modes are never one."""


def common_shapes(
    a: MeasuredModes, b: MeasuredModes
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]] | None:
    """Shapes of both tests at the DOFs that both measured, (n_modes, n_common) each; None for fewer than two DOFs.

    A DOF that points the other way in one of the tests is turned.
    """
    if a.shapes is None or b.shapes is None:
        return None
    of_b = {d.point: i for i, d in enumerate(b.dofs)}
    pairs = [(i, of_b[d.point]) for i, d in enumerate(a.dofs) if d.point in of_b]
    if len(pairs) < 2:
        return None
    at_a, at_b = [i for i, _ in pairs], [j for _, j in pairs]
    sign_a = np.array([a.dofs[i].sign for i in at_a])
    sign_b = np.array([b.dofs[j].sign for j in at_b])
    return a.shapes[:, at_a] * sign_a, b.shapes[:, at_b] * sign_b


def mac_between(a: MeasuredModes, b: MeasuredModes) -> NDArray[np.float64] | None:
    """MAC of all modes of two tests at their common DOFs, (n_a, n_b); None where there are too few."""
    shapes = common_shapes(a, b)
    return None if shapes is None else mac(*shapes)


def match_modes(a: MeasuredModes, b: MeasuredModes) -> NDArray[np.int64]:
    """Index of the mode of `b` for every mode of `a`, -1 for none, (n_a,).

    Pairs have the least sum of (1 - MAC) and of differences of ln f in units of `REACH`; by frequency alone where
    shapes cannot be compared.
    """
    if not len(a) or not len(b):
        return np.full(len(a), -1)
    apart = np.abs(np.log(a.frequency_hz)[:, None] - np.log(b.frequency_hz)[None])
    alike = mac_between(a, b)
    if alike is None:
        cost = apart / REACH_ALONE
        possible = apart < REACH_ALONE
    else:
        alike = np.nan_to_num(alike)
        cost = (1 - alike) + apart / REACH
        possible = (alike >= LEAST_MAC) & (apart < _FARTHEST)
    never = 1e3
    rows, columns = scipy.optimize.linear_sum_assignment(np.where(possible, cost, never))
    found = np.full(len(a), -1)
    for i, j in zip(rows, columns, strict=True):
        if possible[i, j]:
            found[i] = j
    return found
