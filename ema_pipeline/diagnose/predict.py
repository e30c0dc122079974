"""Frequencies that a model predicts from the other modes: the proof that a reader can check with a ruler."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.heldout import Part, fit_without
from ema_pipeline.diagnose.types import HeldOutMode
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem

_ONE_BY_ONE = 8
_STEP = 1e-4


def predict_left_out(case: Case, fitted: Fitted, fit: FitSettings) -> tuple[HeldOutMode, ...]:
    """Every measured frequency beside its prediction by a fit that has not seen the mode.

    Up to eight modes are left out one by one; more of them in `folds` parts, dealt out in turn.

    Parameters
    ----------
    case : Case
    fitted : Fitted
        The model, at its optimum.
    fit : FitSettings
    """
    full = case.problem(fitted.hypothesis, fit)
    total = sum(len(e.measured) for e in full.evidence)
    folds = total if total <= _ONE_BY_ONE else case.settings.folds
    number = np.arange(total) % folds
    found: list[HeldOutMode | None] = [None] * total
    for fold in range(folds):
        out = number == fold
        part = fit_without(case, fitted, full, out)
        if part is None:
            continue
        for r, mode in _predicted(full, part, out):
            found[r] = mode
    return tuple(m for m in found if m is not None)


def _predicted(full: FitProblem, part: Part, out: NDArray[np.bool_]) -> list[tuple[int, HeldOutMode]]:
    x = full.space.point(part.values)
    at, c = part.spread_in(full, x)
    result, start = [], 0
    for e, pairs in zip(full.evidence, full.assignments(x), strict=True):
        f = full.model_omega(e, x) / (2 * np.pi)
        slopes = np.array(
            [
                (full.model_omega(e, x + step) - full.model_omega(e, x - step)) / (4 * np.pi * _STEP)
                for step in np.eye(x.size)[at] * _STEP
            ]
        ).reshape(len(at), f.size)
        for r in np.flatnonzero(out[start : start + pairs.size]):
            k = int(pairs[r])
            m = e.measured
            predicted = float(f[k]) if k >= 0 else float("nan")
            spread = float(np.sqrt(slopes[:, k] @ c @ slopes[:, k])) if k >= 0 else float("nan")
            mode = HeldOutMode(
                m.configuration, float(m.frequency_hz[r]), float(m.frequency_std_hz[r]), predicted, spread
            )
            result.append((start + int(r), mode))
        start += pairs.size
    return result
