"""Modes that the charts missed: where more is left over than hits scatter, a narrow window is searched again.

A weak or sharp mode takes up few lines of a sub-band, and a model of the whole sub-band may spend all its orders
elsewhere. What the fit leaves over shows where such a mode is. The search only pays, and is only made, where the
scatter between hits tells how much should be left over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ema_pipeline.modal.data import FEW_AT_ONCE, FitData
from ema_pipeline.modal.fit import Estimate, LinearSolution, residual_fit, synthesis
from ema_pipeline.modal.noise import Noise, squared
from ema_pipeline.threads import in_order

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]
Search = Callable[[FitData, Noise], Estimate]
"""Candidates in the FRFs of a window with known noise."""

TOO_MUCH = 2.5
"""What is left over, over the scatter between hits (mean over a few lines), above which a mode may be missing."""

FEWEST = 4
"""FRFs without which shapes cannot confirm what a misfit suggests."""

HALF_WINDOW = 48
"""Lines on either side."""

WINDOWS = 4
"""Windows searched, the worst first."""

MOST = 12
"""Candidates of one search beyond which no further window is looked at: so many are no modes but what is left over of
a structure that is not linear, and a fit of all of them takes minutes."""


def left_over(
    data: FitData, hits: Noise, estimate: Estimate, solution: LinearSolution, left: Complex | None = None
) -> Real:
    """Power on each line of what the fit leaves of the FRFs, over what the scatter between hits explains, (n_lines,).

    Parameters
    ----------
    data, hits, estimate, solution
        As for `missed`.
    left : complex ndarray, (n_rows, n_references, n_lines), optional
        Filled with what is left over.
    """

    def of_rows(rows: slice) -> Real:
        some, weight = data.rows(rows), hits.rows(rows).weight(data.measured[rows])
        model = synthesis(some, estimate, solution.shapes[rows])
        model += residual_fit(some, weight, model)
        np.subtract(some.frf, model, out=model)
        model[~some.measured] = 0.0
        if left is not None:
            left[rows] = model
        return np.einsum("oil,oil->l", squared(model), weight)

    power = np.asarray(sum(in_order(of_rows, data.row_blocks(FEW_AT_ONCE))))
    return power / max(int(np.count_nonzero(data.measured)), 1)


def missed(
    data: FitData, hits: Noise, estimate: Estimate, solution: LinearSolution, search: Search
) -> Estimate:
    """Candidates where too much is left over.

    Parameters
    ----------
    data : FitData
    hits : Noise
        From the scatter over hits.
    estimate, solution
        The fit so far.
    search : callable
    """
    found = estimate.take(np.zeros(len(estimate.poles), dtype=bool))
    if np.count_nonzero(data.measured) < FEWEST:
        return found
    left = np.empty(data.frf.shape, dtype=np.complex128)
    ratio = left_over(data, hits, estimate, solution, left)
    ratio = scipy.ndimage.gaussian_filter1d(ratio, 1.5, mode="nearest")
    for _ in range(WINDOWS):
        peak = int(np.argmax(ratio))
        if ratio[peak] < TOO_MUCH or len(found.poles) > MOST:
            break
        first = int(np.clip(peak - HALF_WINDOW, 0, max(len(ratio) - 2 * HALF_WINDOW, 0)))
        stop = min(first + 2 * HALF_WINDOW, len(ratio))
        window = replace(data.lines(first, stop), frf=left[..., first:stop])
        fresh = search(window, hits.lines(first, stop))
        distance = np.abs(fresh.poles[:, None] - found.poles[None]).min(axis=1, initial=np.inf)
        found = found.joined(fresh.take(distance > -0.5 * fresh.poles.real))
        ratio[max(0, peak - HALF_WINDOW // 2) : peak + HALF_WINDOW // 2] = 0.0
    return found
