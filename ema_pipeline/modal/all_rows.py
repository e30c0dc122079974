"""Poles placed by all struck points, each by its own noise.

With a roving hammer rows are points, and no two points were struck alike. Combinations of rows find the modes at a
fraction of the work, but they weigh a row alike at all lines, and mix points that one mode model describes well with
others that it does not: struck harder, at another time, or near a node. Poles from combinations then scatter by several
times what those of all rows do. Many sensors of the same hits do not differ in this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.compress import Window
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import Estimate, Step, best_shapes, newton_step, solve_linear
from ema_pipeline.modal.heavily_damped import has_peak
from ema_pipeline.modal.mode_acceptance import PLAIN_DAMPING
from ema_pipeline.modal.polish import descend
from ema_pipeline.modal.segment import SegmentFit, gone_astray, measured_noise, put_back
from ema_pipeline.threads import in_order

Real = NDArray[np.float64]

ENOUGH = 0.1
"""Gain of a step in the weighted sum of squares below which poles stay: they then lie within a third of a standard
deviation."""

FARTHEST = 1.0
"""A pole that all rows move farther than its decay rate is not the mode that was found."""


@dataclass(frozen=True)
class _Sums:
    """What all blocks of rows add up to: weighted sum of squares and normal equations."""

    cost: float
    step: Step


def placed(
    window: Window, start: Estimate, held: NDArray[np.bool_], iterations: int
) -> tuple[Estimate, NDArray[np.bool_]]:
    """Modes of combinations of rows, placed where all rows want them.

    Parameters
    ----------
    window : Window
    start : Estimate
        Of the combinations.
    held : ndarray of bool, (n_modes,)
        Modes that stay where they are.
    iterations : int
        Of the descent at most; 0 keeps the poles where they are.

    Returns
    -------
    Estimate
    held : ndarray of bool, (n_modes,)
        Modes that stay where `start` has them: held there before, or driven away by the rows.
    """
    if not iterations:
        return start, held
    blocks = window.data.row_blocks()

    def weight_of(rows: slice) -> Real:
        data, linear = linear_fit(window.rows(rows), start)
        return linear.noise.weight(data.measured)

    weights = list(in_order(weight_of, blocks))

    def sums(estimate: Estimate) -> _Sums:
        def of_rows(block: tuple[slice, Real]) -> _Sums:
            rows, weight = block
            solution = solve_linear(window.rows(rows).near().data, weight, estimate)
            return _Sums(solution.cost, newton_step(estimate, solution))

        return _added(list(in_order(of_rows, list(zip(blocks, weights, strict=True)))))

    while True:
        estimate = descend(start, sums, lambda _, found: found.step, iterations, held, ENOUGH)[0]
        far = np.abs(estimate.poles - start.poles) > FARTHEST * -start.poles.real
        lost = (far | gone_astray(window.data, start, estimate)) & ~held
        if not lost.any():
            return estimate, held
        start, held = put_back(estimate, start, lost), held | lost


def backgrounds(data: FitData, estimate: Estimate) -> NDArray[np.bool_]:
    """Poles with much damping and no peak in the response of all rows, (n_modes,)."""
    out = -estimate.poles.real > PLAIN_DAMPING * np.abs(estimate.poles)
    if out.any():
        power = np.sum(np.abs(data.frf) ** 2, axis=(0, 1))
        out[out] = [not has_peak(data.omega, power, pole) for pole in estimate.poles[out]]
    return out


def _added(parts: list[_Sums]) -> _Sums:
    return _Sums(
        sum(p.cost for p in parts),
        Step(
            np.asarray(sum(p.step.information for p in parts)),
            np.asarray(sum(p.step.gradient for p in parts)),
        ),
    )


def linear_fit(window: Window, estimate: Estimate) -> tuple[FitData, SegmentFit]:
    """Shapes of some rows for poles that are known, at the noise that they leave over."""
    local = window.near()
    data, noise = local.data, local.noise
    for _ in range(2):
        weight = noise.weight(data.measured)
        shapes = best_shapes(data, weight, estimate).shapes
        noise = measured_noise(data, local.hits, estimate, shapes, weight)
    solution = solve_linear(data, noise.weight(data.measured), estimate)
    nowhere = np.zeros(len(estimate.poles))
    return data, SegmentFit(estimate, solution, noise, nowhere.astype(bool), nowhere.astype(complex))
