"""Frequencies that a model predicts from the other modes: the proof that a reader can check with a ruler."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.heldout import subset
from ema_pipeline.diagnose.types import HeldOutMode
from ema_pipeline.fit.map_fit import posterior_covariance
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, refine

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
        kept, start = {}, 0
        for e in full.evidence:
            m = case.measured[e.measured.configuration]
            kept[m.configuration] = subset(m, number[start : start + len(m)] != fold)
            start += len(m)
        if not any(len(m) for m in kept.values()):
            continue
        part = case.problem(fitted.hypothesis, fit, kept)
        optimum = refine(part, part.space.point(fitted.values))
        # what a failing model has turned into outliers speaks as well
        trusting = replace(optimum, inlier=np.ones_like(optimum.inlier))
        covariance = posterior_covariance(part, trusting, 1.0)
        values = {**fitted.values, **part.space.named(optimum.x)}
        for r, mode in _predicted(full, part, values, covariance, number == fold):
            found[r] = mode
    return tuple(m for m in found if m is not None)


def _predicted(
    full: FitProblem,
    part: FitProblem,
    values: dict[str, float],
    covariance: NDArray[np.float64],
    out: NDArray[np.bool_],
) -> list[tuple[int, HeldOutMode]]:
    x = full.space.point(values)
    own = [i for i, n in enumerate(part.space.names) if n in full.space.names]
    at = [full.space.names.index(part.space.names[i]) for i in own]
    c = covariance[np.ix_(own, own)]
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
