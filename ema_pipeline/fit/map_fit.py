"""The weighted fit of all parameters over all configurations, with uncertainty and identifiability."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.error_function import RING_PLANET, SUN_PLANET, error_sweep, mode_counts, two_step
from ema_pipeline.fit.identifiability import judge_free, judge_prior
from ema_pipeline.fit.profile import interval, profile
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, Optimum, Progress, refine, search
from ema_pipeline.fit.types import ErrorSweep, FitResult, ParameterEstimate, TwoStep
from ema_pipeline.rigs.types import Parameter, Rig
from ema_pipeline.threads import single_blas_thread


def fit_rig(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: FitSettings | None = None,
    start: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Fit all of a rig's uncertain parameters to the measured modes of all configurations at once.

    Parameters
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
        With shapes, or frequencies only; configurations without modes are passed over.
    settings : FitSettings, optional
    start : mapping of parameter to value, optional
        A further starting point, e.g. the fit of a poorer model: the result is never worse than there.
    progress : callable, optional
        Called with the share done (0…1) and a word on what is being done.

    Returns
    -------
    FitResult
        Deterministic: the same data and settings give the same numbers.

    Raises
    ------
    EmaError
        If there is nothing to fit.
    """
    settings = settings or FitSettings()
    tell = progress or (lambda share, text: None)
    with single_blas_thread():
        problem = FitProblem(rig, measured, settings)
        if not problem.space.coordinates:
            raise EmaError(
                f"rig '{rig.name}' has no parameter with a tolerance or marked free: nothing to fit; "
                "add 'tolerance' or 'free = true' in the rig file"
            )
        best = search(problem, start, tell)
        plain = best
        best, scale = misfit_scale(problem, best)
        tell(0.85, "profiles")
        result = _report(problem, plain, best, scale)
        tell(0.95, "error function")
        sweeps, steps = _seed_route(rig, problem, measured, settings)
        tell(1.0, "done")
    return replace(result, sweeps=sweeps, two_step=steps)


def chi2_per_dof(problem: FitProblem, found: Optimum) -> float:
    """Sum of squares of inliers and priors over their number, less the parameters without prior."""
    finite = np.isfinite(found.costs)
    weight = np.where(finite, found.inlier, 0.0)
    prior = problem.space.has_prior
    chi2 = float(np.sum(weight * np.where(finite, found.costs, 0.0)) + np.sum(found.x[prior] ** 2))
    dof = float(np.sum(weight * problem.counts)) - float(np.sum(~prior))
    return chi2 / max(dof, 1.0)


def _full_chi2_per_dof(problem: FitProblem, found: Optimum) -> float:
    """The same over every mode that has a partner, outliers included: they must not make a wrong model "
    "look good."""
    paired = np.where(np.isfinite(found.costs), 1.0, 0.0)
    return chi2_per_dof(problem, replace(found, inlier=paired))


def misfit_scale(problem: FitProblem, found: Optimum) -> tuple[Optimum, float]:
    """Widen all standard uncertainties where the model does not reach them, and fit again.

    With the data's own uncertainties a wrong model first turns modes into outliers. Where these become too
    many it is
    the model that is wrong: the uncertainties are multiplied by 2, 4, … until at most `outlier_limit` is left
    out,
    and then by √(χ²/dof) if that is still above 1.

    Returns
    -------
    Optimum, float
        The fit at the widened uncertainties, and by what they were multiplied (1 for a model that holds).
    """
    scale, here = 1.0, found
    while 1 - float(np.mean(here.inlier)) > problem.settings.outlier_limit and scale < 1e4:
        scale *= 2.0
        here = refine(problem, here.x, scale)
    for _ in range(8):
        # wider uncertainties take former outliers back in, and the tolerances hold the parameters tighter
        wanted = float(np.sqrt(max(chi2_per_dof(problem, here), 1.0)))
        if wanted <= 1.02 * scale:
            break
        scale = wanted
        here = refine(problem, here.x, scale)
    return here, scale


def posterior_covariance(problem: FitProblem, found: Optimum, scale: float) -> NDArray[np.float64]:
    """Inverse Gauss-Newton Hessian of the coordinates at the optimum, priors included, (P, P).

    A free logarithm gets the variance of a uniform distribution between its bounds as its prior, so that a
    direction
    that the data say nothing about has a large, not an infinite variance.
    """
    space = problem.space
    objective = problem.exact(problem.assignments(found.x))
    normal, _ = objective.normal_equations(found.x, found.inlier / scale**2)
    width = space.high - space.low
    bounded = np.isfinite(width) & ~space.has_prior
    weak = np.where(bounded, 12 / np.where(bounded, width, 1.0) ** 2, 1e-12)
    hessian = normal + np.diag(np.where(space.has_prior, 1.0, weak))
    scaling = 1 / np.sqrt(np.diag(hessian))
    inverse = np.linalg.inv(hessian * scaling[:, None] * scaling[None, :])
    return np.asarray(inverse * scaling[:, None] * scaling[None, :])


def _report(problem: FitProblem, plain: Optimum, best: Optimum, scale: float) -> FitResult:
    space, settings = problem.space, problem.settings
    covariance = posterior_covariance(problem, best, scale)
    free = [i for i, c in enumerate(space.coordinates) if c.kind != "prior"]
    profiles = {}
    for attempt in range(2):
        lowest = best
        for i in free:
            profiles[i], found = profile(problem, best, covariance, i, scale)
            lowest = min(lowest, found, key=lambda o: o.objective)
        if attempt or lowest.objective > best.objective - 0.1:
            break
        # the profile found a better optimum than the search
        best = refine(problem, lowest.x, scale)
        covariance = posterior_covariance(problem, best, scale)

    slopes, values = space.slopes(best.x), space.values(best.x)
    std = np.sqrt(np.diag(covariance)) * np.abs(slopes)
    estimates: dict[str, ParameterEstimate] = {}
    for i, c in enumerate(space.coordinates):
        p, value, sigma = c.parameter, float(values[i]), float(std[i])
        at_bound = bool(best.x[i] <= c.low or best.x[i] >= c.high)
        if c.kind == "prior":
            judged = judge_prior(sigma, c.scale, float(best.x[i]), at_bound, settings)
            estimates[p.name] = ParameterEstimate(
                p.name, value, sigma, value - sigma, value + sigma, p.unit, False, p.value, c.scale,
                judged.identified, float(best.x[i]), judged.note,
            )  # fmt: skip
            continue
        shape = profiles[i]
        judged = judge_free(c, shape, value, sigma, settings)
        low, high = interval(shape, c.value(c.low), c.value(c.high), c.kind == "log")
        estimates[p.name] = ParameterEstimate(
            p.name, value, sigma if judged.identified else float("nan"), low, high, p.unit, True, p.value,
            float("nan"), judged.identified, float("nan"), judged.note, shape,
        )  # fmt: skip
    for p in problem.irrelevant:
        estimates[p.name] = _not_measured(p)

    deviation = np.sqrt(np.diag(covariance))
    chi2 = _full_chi2_per_dof(problem, best)
    outliers = float(1 - np.mean(best.inlier))
    return FitResult(
        parameters=estimates,
        names=space.names,
        correlation=covariance / np.outer(deviation, deviation),
        error=_error(problem, best),
        chi2_per_dof=chi2,
        frequency_error=_paired_frequency_error(problem, best.x),
        data_count=round(float(np.sum(problem.counts))),
        stop_reason=best.stop_reason,
        notes=_notes(problem, best, scale, chi2, outliers),
        objective=plain.objective,
        outlier_share=outliers,
        misfit_scale=scale,
    )


def _error(problem: FitProblem, found: Optimum) -> float:
    """Root-mean-square residual over all data of the paired modes; NaN without pairs."""
    paired = np.isfinite(found.costs)
    if not np.any(paired):
        return float("nan")
    return float(np.sqrt(np.sum(found.costs[paired]) / np.sum(problem.counts[paired])))


def _notes(problem: FitProblem, best: Optimum, scale: float, chi2: float, outliers: float) -> tuple[str, ...]:
    notes = []
    if scale > 1:
        notes.append(
            f"the model does not reach the data's accuracy (χ²/dof {chi2:.3g}): all uncertainties were "
            f"multiplied by {scale:.3g}, and the standard deviations hold only as far as the misfit acts "
            "like random scatter"
        )
    start = 0
    for e in problem.evidence:
        out = best.inlier[start : start + len(e.measured)] < 0.5
        start += len(e.measured)
        if np.any(out):
            which = ", ".join(f"{f:.1f}" for f in e.measured.frequency_hz[out])
            notes.append(f"{e.measured.configuration}: left out as outliers: {which} Hz")
    if outliers > 0.2:
        notes.append(
            f"{100 * outliers:.0f} % of the measured modes fit no mode of the model: "
            "something is missing in it"
        )
    if not any(e.has_shapes for e in problem.evidence):
        notes.append("frequencies only: which measured mode is which model mode rests on nearness alone")
    return tuple(notes)


def _not_measured(p: Parameter) -> ParameterEstimate:
    sigma = float("nan") if p.free else abs(p.tolerance * p.value)
    return ParameterEstimate(
        name=p.name,
        value=p.value,
        std=sigma,
        low=p.minimum if p.free else p.value - sigma,
        high=p.maximum if p.free else p.value + sigma,
        unit=p.unit,
        free=p.free,
        nominal=p.value,
        prior_std=float("nan") if p.free else sigma,
        identified=False,
        shift_z=float("nan") if p.free else 0.0,
        note="not measured: nothing that was measured depends on it",
    )


def _paired_frequency_error(problem: FitProblem, x: NDArray[np.float64]) -> float:
    total = 0.0
    for e, pairs, modes in zip(problem.evidence, problem.assignments(x), problem.modes(x), strict=True):
        omega = modes.omega[0]
        has = pairs >= 0
        total += float(np.sum((e.omega[has] / omega[pairs[has]] - 1) ** 2))
    return total


def _seed_route(
    rig: Rig, problem: FitProblem, measured: Mapping[str, MeasuredModes], settings: FitSettings
) -> tuple[tuple[ErrorSweep, ...], TwoStep | None]:
    """Sweeps of ε over every free stiffness, each in the first configuration that depends on it."""
    sweeps = []
    held: dict[str, float] = {}
    by_name = {e.measured.configuration: e for e in problem.evidence}
    for i, c in enumerate(problem.space.coordinates):
        if c.kind != "log":
            continue
        configuration = next(
            (k for k in rig.configurations if k in by_name and by_name[k].family.relevant[i]), None
        )
        if configuration is None:
            continue
        frequency = measured[configuration].frequency_hz
        for count in mode_counts(frequency.size):
            sweeps.append(error_sweep(rig, configuration, c.parameter.name, frequency, count, settings, held))
        held[c.parameter.name] = sweeps[-1].minimum
    known = SUN_PLANET in rig.parameters and RING_PLANET in rig.parameters
    return tuple(sweeps), two_step(rig, measured, settings) if known else None
