"""Refine poles and participations on the FRFs, with step control."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.fit import (
    BestShapes,
    Estimate,
    Step,
    best_shapes,
    free_participations,
    moved,
    newton_step,
    normalised,
    with_slopes,
)

Real = NDArray[np.float64]

MAX_ITERATIONS = 25
LARGEST_STEP = 0.5
"""A pole moves by at most this share of its decay rate per iteration."""

CONVERGED = 1e-3
"""Stop when a step lowers the weighted sum of squares by less than this: parameters then move by a few
hundredths of their standard deviation."""


class Cost(Protocol):
    """A linear solution."""

    @property
    def cost(self) -> float:
        """Weighted sum of squares of the residual."""


S = TypeVar("S", bound=Cost)


def descend(
    start: Estimate,
    solve: Callable[[Estimate], S],
    slope: Callable[[Estimate, S], Step],
    iterations: int,
    held: NDArray[np.bool_] | None = None,
    enough: float = CONVERGED,
) -> tuple[Estimate, S]:
    """Levenberg–Marquardt on poles and participations.

    Parameters
    ----------
    start : Estimate
    solve : callable
        Best linear solution of an estimate, with its cost.
    slope : callable
        Normal equations of the nonlinear parameters at an estimate and its solution.
    iterations : int
    held : ndarray of bool, (n_modes,), optional
        Modes whose poles and participations stay as they are.
    enough : float
        Gain of a step below which the descent ends.

    Returns
    -------
    Estimate, S
        The best found; the start where no step improves it.
    """
    estimate = Estimate(start.poles, normalised(start.participation))
    solution = solve(estimate)
    damping = 1e-3
    for _ in range(iterations):
        step = slope(estimate, solution)
        fixed = _fixed(estimate, held)
        step = _without(step, fixed)
        diagonal = np.diag(step.information).copy()
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        scale = 1 / np.sqrt(diagonal)
        accepted = False
        change = np.zeros(len(diagonal))
        for _ in range(6):
            scaled = step.information * scale[:, None] * scale[None]
            scaled[np.diag_indices_from(scaled)] += damping
            try:
                change = scale * np.linalg.lstsq(scaled, scale * step.gradient, rcond=1e-13)[0]
                # rounding must not move what is held: it is recognised by its exact pole
                change = np.where(fixed, 0.0, _limited(estimate, change))
                trial = moved(estimate, change)
                trial_solution = solve(trial)
            except np.linalg.LinAlgError:  # a step too far: a shorter one may do
                trial_solution = solution
            if trial_solution.cost < solution.cost:
                accepted = True
                break
            damping = max(10 * damping, 1e-6)
        if not accepted:
            break
        gain = solution.cost - trial_solution.cost
        estimate, solution = trial, trial_solution
        damping *= 0.1
        if gain < enough:
            break
        pivoted = normalised(estimate.participation)
        if np.max(np.abs(estimate.participation)) > 1.5:
            estimate = Estimate(estimate.poles, pivoted)
            solution = solve(estimate)
    return estimate, solution


def polish(
    data: FitData,
    weight: Real,
    start: Estimate,
    iterations: int = MAX_ITERATIONS,
    held: NDArray[np.bool_] | None = None,
) -> tuple[Estimate, BestShapes]:
    """Descend on poles and participations, shapes and residual terms eliminated.

    Parameters
    ----------
    data : FitData
    weight : ndarray, (n_rows, n_references, n_lines)
        One over variance; 0 where not measured.
    start : Estimate
    iterations : int
    held : ndarray of bool, (n_modes,), optional
        Modes whose poles and participations stay as they are.

    Returns
    -------
    Estimate, BestShapes
        The best found; the start where no step improves it.
    """

    def slope(estimate: Estimate, best: BestShapes) -> Step:
        return newton_step(estimate, with_slopes(data, weight, estimate, best))

    return descend(start, partial(best_shapes, data, weight), slope, iterations, held)


def _fixed(estimate: Estimate, held: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """The parameters of the modes that are held, (n_parameters,)."""
    if held is None:
        held = np.zeros(len(estimate.poles), dtype=bool)
    modes = [r for r, _ in free_participations(estimate)]
    return np.repeat(np.concatenate([held, held[modes]]), 2)


def _without(step: Step, fixed: NDArray[np.bool_]) -> Step:
    """Normal equations in which some parameters do not move."""
    information, gradient = step.information.copy(), np.where(fixed, 0.0, step.gradient)
    information[fixed] = information[:, fixed] = 0.0
    return Step(information, gradient)


def _limited(estimate: Estimate, change: Real) -> Real:
    """Shorten the step of every pole to a share of its decay rate; participations to order one."""
    m = len(estimate.poles)
    out = change.copy()
    size = np.hypot(out[0 : 2 * m : 2], out[1 : 2 * m : 2])
    allowed = LARGEST_STEP * np.abs(estimate.poles.real)
    factor = np.minimum(1.0, allowed / np.maximum(size, 1e-300))
    out[0 : 2 * m : 2] *= factor
    out[1 : 2 * m : 2] *= factor
    out[2 * m :] = np.clip(out[2 * m :], -1.0, 1.0)
    return out
