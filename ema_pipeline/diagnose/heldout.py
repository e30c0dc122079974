"""Held-out proof: each part of the data is predicted by a fit that has not seen it.

Modes and nominal values of parameters alike are data: both are left out in turn. A prediction's own uncertainty is
counted with that of the datum, so about 1 means that the model predicts as well as it claims to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.residuals import mode_residuals, observable_modes
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.fit.map_fit import posterior_covariance
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, refine

_STEP = 1e-4
_LOOSE = 30.0


@dataclass(frozen=True)
class HeldOut:
    """Squares of the held-out residuals of every measured mode and of every nominal value.

    Attributes
    ----------
    modes : ndarray, (R,)
        Infinite for modes without partner.
    parameters : dict of str to float
    """

    modes: NDArray[np.float64]
    parameters: dict[str, float]


def held_out(case: Case, fitted: Fitted, fit: FitSettings, folds: int) -> HeldOut:
    """Predict every mode and every nominal value from the others.

    Parameters
    ----------
    case : Case
    fitted : Fitted
        Optimum from which every refit starts.
    fit : FitSettings
    folds : int
        Parts; modes are dealt out in turn over all configurations, so that each part spans all frequencies.
    """
    full = case.problem(fitted.hypothesis, fit)
    total = sum(len(e.measured) for e in full.evidence)
    modes = np.full(total, np.inf)
    parameters: dict[str, float] = {}
    priors = [c.parameter.name for c in full.space.coordinates if c.kind == "prior"]
    number = np.arange(total) % folds
    for fold in range(folds):
        out = number == fold
        loose = [n for i, n in enumerate(priors) if i % folds == fold]
        part = fit_without(case, fitted, full, out, loose)
        if part is None:
            continue
        for n in loose:
            if n not in part.problem.space.names:
                continue
            i = part.problem.space.names.index(n)
            # In units of the tolerance that was widened: prediction against nominal value.
            shift, spread = part.x[i] * _LOOSE, np.sqrt(part.covariance[i, i]) * _LOOSE
            known = part.problem.space.coordinates[i].kind == "prior"
            parameters[n] = float(shift**2 / (1 + spread**2)) if known else 0.0
        modes[out] = _predicted(full, part, out)
    return HeldOut(modes, parameters)


@dataclass(frozen=True)
class Part:
    """A fit that has not seen some of the modes.

    Attributes
    ----------
    problem : FitProblem
        Of the modes that it has seen.
    x : ndarray, (P,)
        Its optimum.
    values : dict of str to float
        All parameters there.
    covariance : ndarray, (P, P)
        Of the coordinates.
    """

    problem: FitProblem
    x: NDArray[np.float64]
    values: dict[str, float]
    covariance: NDArray[np.float64]

    def spread_in(self, full: FitProblem, x: NDArray[np.float64]) -> tuple[list[int], NDArray[np.float64]]:
        """Coordinates of the fit to all modes that the part has as well, and the part's covariance in them."""
        own = [i for i, n in enumerate(self.problem.space.names) if n in full.space.names]
        at = [full.space.names.index(self.problem.space.names[i]) for i in own]
        # A step in the part's coordinate is another one in the full space where a tolerance was widened.
        ratio = np.array(
            [
                self.problem.space.coordinates[i].slope(float(x[j]))
                / full.space.coordinates[j].slope(float(x[j]))
                for i, j in zip(own, at, strict=True)
            ]
        )
        return at, self.covariance[np.ix_(own, own)] * np.outer(ratio, ratio)


def fit_without(
    case: Case, fitted: Fitted, full: FitProblem, out: NDArray[np.bool_], loose: Sequence[str] = ()
) -> Part | None:
    """Fit again without some of the modes; None where no mode is left.

    Parameters
    ----------
    case : Case
    fitted : Fitted
        Optimum from which the refit starts.
    full : FitProblem
        The fit to all modes.
    out : bool ndarray, (R,)
        The modes left out.
    loose : sequence of str, optional
        Parameters whose nominal values are left out as well: their tolerances are widened.
    """
    kept = _without(case, full, out)
    if not any(len(m) for m in kept.values()):
        return None
    problem = case.problem(fitted.hypothesis, full.settings, kept, dict.fromkeys(loose, _LOOSE))
    found = refine(problem, problem.space.point(fitted.values))
    # a model that fails has turned data into outliers: without them it would know too little to be wrong
    trusting = replace(found, inlier=np.ones_like(found.inlier))
    covariance = posterior_covariance(problem, trusting, 1.0)
    return Part(problem, found.x, {**fitted.values, **problem.space.named(found.x)}, covariance)


def _without(case: Case, full: FitProblem, out: NDArray[np.bool_]) -> dict[str, MeasuredModes]:
    kept, start = {}, 0
    for e in full.evidence:
        m = case.measured[e.measured.configuration]
        keep = ~out[start : start + len(m)]
        start += len(m)
        kept[m.configuration] = subset(m, keep)
    return kept


def subset(m: MeasuredModes, keep: NDArray[np.bool_]) -> MeasuredModes:
    """Some of the measured modes."""
    return replace(
        m,
        frequency_hz=m.frequency_hz[keep],
        frequency_std_hz=m.frequency_std_hz[keep],
        damping_ratio=m.damping_ratio[keep],
        damping_std=m.damping_std[keep],
        shapes=None if m.shapes is None else m.shapes[keep],
        shape_std=None if m.shape_std is None else m.shape_std[keep],
    )


def _predicted(full: FitProblem, part: Part, out: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Squared residual of each held-out mode in units of datum's and prediction's uncertainty together."""
    x = full.space.point(part.values)
    pairs = full.assignments(x)
    at, c = part.spread_in(full, x)
    steps = np.zeros((len(at), x.size))
    steps[np.arange(len(at)), at] = _STEP
    points = np.vstack([x[None], x + steps, x - steps])
    result, start = [], 0
    for e, p in zip(full.evidence, pairs, strict=True):
        here = out[start : start + p.size]
        start += p.size
        squares = np.full(p.size, np.inf)
        use = here & (p >= 0)
        if np.any(use):
            r = mode_residuals(
                e, np.where(use, p, -1), observable_modes(e.family.at(points)), full.settings.mode_mixing
            )
            jacobian = (r[1 : 1 + len(at)] - r[1 + len(at) :]) / (2 * _STEP)
            for k in np.flatnonzero(use):
                j = jacobian[:, k, :]
                spread = np.eye(r.shape[2]) + j.T @ c @ j
                squares[k] = float(r[0, k] @ np.linalg.solve(spread, r[0, k]))
        result.append(squares[here])
    return np.concatenate(result)


def error_of(
    costs: NDArray[np.float64],
    counts: NDArray[np.float64],
    unpaired: NDArray[np.float64],
    counted: NDArray[np.bool_],
    prior_squares: float,
    prior_count: int,
) -> float:
    """Root-mean-square of (measurement - model)/standard uncertainty over modes and nominal values.

    A mode without partner counts as `unpaired`; modes that no hypothesis at all explains are not `counted`.
    """
    with_partner = np.where(np.isfinite(costs), costs, unpaired)
    total = float(np.sum(with_partner[counted])) + prior_squares
    size = float(np.sum(counts[counted])) + prior_count
    return float(np.sqrt(total / size)) if size else float("nan")
