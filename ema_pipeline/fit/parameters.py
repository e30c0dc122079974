"""Fitted parameters, read from the posterior of everything uncertain, and the published error function beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.error_function import error_sweep, mode_counts, stepwise
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.types import ErrorSweep, FitResult, ParameterEstimate, StepwiseEstimate
from ema_pipeline.inference import Posterior
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    at_scatters,
    averaged,
    fit_base,
    learned,
    made_up_of,
    wide,
)
from ema_pipeline.observations.mode_problem import ModeProblem
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.types import Parameter, Rig

_OUT_OF_TOLERANCE = 3.0
"""Prior standard deviations from the stated value from which a parameter is remarked."""
_UNTOUCHED = 0.999
"""Posterior over prior standard deviation from which nothing that was measured depends on a parameter."""


@dataclass(frozen=True)
class FittedModes:
    """A model fitted to measured modes: what fit, comparison and report share.

    Attributes
    ----------
    observations : ModeObservations
    problem : ModeProblem
    fit : Fit
    """

    observations: ModeObservations
    problem: ModeProblem
    fit: Fit

    @property
    def posterior(self) -> Posterior:
        """Posterior of everything uncertain."""
        return self.fit.posterior

    def system(self, configuration: str) -> LinearSystem:
        """The fitted model's system, every part with its own deviation."""
        model = self.problem.model
        return model.system(configuration, self.posterior.x[: len(model.unknowns)])

    def system_of_like_parts(self, configuration: str) -> LinearSystem:
        """The fitted model's system, like parts being alike: what the single parts deviate is left out."""
        model = self.problem.model
        single = np.array([bool(name) for name in model.unknowns.scatter])
        x = np.where(single, 0.0, self.posterior.x[: len(model.unknowns)])
        return model.system(configuration, x)


def fit_modes(
    observations: ModeObservations,
    model: Model,
    scatters: Mapping[str, float] | None = None,
    start: Mapping[str, float] | None = None,
) -> FittedModes:
    """Fit a model to measured modes.

    Parameters
    ----------
    observations : ModeObservations
    model : Model
    scatters : dict of str to float, optional
        What parts, channels, damping and the model scatter; learned where left out.
    start : dict of str to float, optional
        Unknowns of an earlier fit of this model to these data, which is then only refined; begun anew where they are
        not admissible.

    Raises
    ------
    EmaError
        If the rig has nothing that is uncertain, or there is no mode.
    """
    if not observations.data:
        raise EmaError(
            f"no mode was measured that rig '{observations.rig.name}' could be fitted to; widen modal.identify.low_hz "
            "and high_hz, or take modes in with 'ema include'"
        )
    problem = observations.problem(model.effects, model.scales)
    if not len(problem.model.unknowns):
        raise EmaError(
            f"rig '{observations.rig.name}' has no parameter with a tolerance or marked free: nothing to fit; "
            "add 'tolerance' or 'free = true' in the rig file"
        )
    fit = None if start is None else begun_at(observations, model, start)
    if fit is None or not np.isfinite(fit.log_evidence):
        fit = fit_base(observations, model)
    done = learned(observations, fit) if scatters is None else at_scatters(observations, fit, scatters)
    return FittedModes(observations, problem, done)


def begun_at(
    observations: Observations,
    model: Model,
    unknowns: Mapping[str, float],
    scatters: Mapping[str, float] | None = None,
) -> Fit:
    """A model at given unknowns, those left out at their means; at the scatters where fits begin, if none are given."""
    problem = model.problem(observations)
    x = np.array([unknowns.get(n, 0.0) for n in problem.unknowns.names])
    scatters = wide(observations) if scatters is None else scatters
    return Fit(model, Posterior(problem.unknowns, x, scatters, problem.residuals(x, scatters)))


def deviations_of(fit: Fit) -> dict[str, float]:
    """How far everything uncertain but the effects' sizes had to move from what is stated, in prior 1 σ, by name."""
    posterior, sizes = fit.posterior, {f"{label}." for label in fit.model.labels}
    return {
        name: float(x / std)
        for name, x, std in zip(posterior.unknowns.names, posterior.x, posterior.prior_std, strict=True)
        if not any(name.startswith(size) for size in sizes)
    }


def restored(observations: ModeObservations, model: Model, found: FitResult) -> FittedModes:
    """The fitted model of stored results."""
    problem = observations.problem(model.effects, model.scales)
    return FittedModes(observations, problem, begun_at(observations, model, found.unknowns, found.scatters))


def fit_result(
    fitted: FittedModes, rig: Rig, measured: Mapping[str, MeasuredModes], settings: FitSettings
) -> FitResult:
    """Parameters with uncertainty and identifiability, and the seed's error function.

    Parameters
    ----------
    fitted : FittedModes
    rig : Rig
        With the effects of the model.
    measured : dict of str to MeasuredModes
    settings : FitSettings
    """
    posterior = fitted.posterior
    sized = replace(fitted, fit=averaged(fitted.observations, fitted.fit))
    estimates = _estimates(sized, rig, settings)
    names = tuple(n for n in estimates if n in posterior.unknowns.index)
    covariance, _ = sized.posterior.of_sums([made_up_of(fitted.problem, n) for n in names])
    deviation = np.sqrt(np.diag(covariance))
    sweeps, steps = seed_route(rig, measured, settings)
    return FitResult(
        parameters=estimates,
        names=names,
        correlation=covariance / np.outer(deviation, deviation) if len(names) else np.zeros((0, 0)),
        error=posterior.error,
        chi2_per_dof=posterior.error**2,
        frequency_error=_frequency_error(fitted),
        data_count=posterior.residuals.count,
        stop_reason="converged",
        sweeps=sweeps,
        stepwise=steps,
        notes=_notes(fitted),
        unknowns=fitted.fit.unknowns,
        scatters={k: float(v) for k, v in posterior.scatters.items()},
    )


def _estimates(fitted: FittedModes, rig: Rig, settings: FitSettings) -> dict[str, ParameterEstimate]:
    values = fitted.problem.parameter_values(fitted.posterior.x)
    found = {}
    for name, value in values.items():
        parameter = rig.parameters.get(name)
        if parameter is not None and (parameter.free or parameter.tolerance > 0):
            found[name] = _estimate(fitted, parameter, value, settings)
    return found


def _estimate(fitted: FittedModes, p: Parameter, value: float, settings: FitSettings) -> ParameterEstimate:
    posterior = fitted.posterior
    i = posterior.unknowns.index.get(p.name)
    prior = float("nan") if p.free else abs(p.tolerance * p.value)
    if i is None:
        return _not_measured(p, value, prior)
    terms = made_up_of(fitted.problem, p.name)
    after, before = (float(np.sqrt(c[0, 0])) for c in posterior.of_sums([terms]))
    narrowing = after / before
    if p.free and narrowing > _UNTOUCHED:
        return _not_measured(p, value, prior)
    size = fitted.problem.sizes.get(p.name)
    slope = abs(value) if size is None else abs(size.slope(float(posterior.x[i])))
    std = after * slope
    low, high = value - std, value + std
    if size is None:  # a logarithm: the interval is one of factors
        factor = float(np.exp(after))
        low, high = max(value / factor, p.minimum), min(value * factor, p.maximum)
    identified = narrowing < settings.narrowed
    if p.free and size is None:
        identified = identified and after < settings.relative_std_limit
    shift = float("nan") if p.free else sum(w * posterior.value(n) for n, w in terms.items()) / before
    notes = []
    if np.isfinite(shift) and abs(shift) > _OUT_OF_TOLERANCE:
        notes.append(
            f"out of tolerance: the data put it {shift:+.1f} standard deviations from its stated value"
        )
    if not identified:
        notes.append(
            f"not identified: the data narrow it to {100 * narrowing:.0f} % of what was known before"
            if p.free
            else "the data say little: the tolerance determines it"
        )
    return ParameterEstimate(
        p.name, value, std, low, high, p.unit, p.free, p.value, prior, identified, shift, "; ".join(notes),
    )  # fmt: skip


def _not_measured(p: Parameter, value: float, prior: float) -> ParameterEstimate:
    """A parameter that nothing measured depends on: its prior, or where it is free, nothing but its bounds."""
    std, shift = (float("nan"), float("nan")) if p.free else (abs(p.tolerance * p.value), 0.0)
    low, high = (p.minimum, p.maximum) if p.free else (value - std, value + std)
    why = "not measured: nothing that was measured depends on it"
    if not p.free and p.value == 0:
        why = "stated to be 0: a tolerance is a share of that"
    return ParameterEstimate(
        p.name, value, std, low, high, p.unit, p.free, p.value, prior, False, shift, why
    )  # fmt: skip


def _notes(fitted: FittedModes) -> tuple[str, ...]:
    notes = []
    if fitted.posterior.fails():
        notes.append(
            f"the model does not explain the data (error {fitted.posterior.error:.1f}): standard deviations of "
            "parameters hold for a model that does"
        )
    left = fitted.posterior.residuals.unexplained
    for data, match in zip(fitted.observations.data, _matching(fitted), strict=True):
        alone = np.exp(data.log_frequency[match < 0])
        if len(alone):
            which = ", ".join(f"{f:.1f}" for f in alone)
            notes.append(f"{data.configuration}: no model mode for {which} Hz")
    if left and not notes:
        notes.append(f"{left} measured modes have no model mode")
    if not any(d.shapes.shape[1] for d in fitted.observations.data):
        notes.append("frequencies only: measured and model modes are paired by frequency alone")
    return tuple(notes)


def _matching(fitted: FittedModes) -> tuple[np.ndarray, ...]:
    matching = fitted.posterior.residuals.matching
    assert isinstance(matching, tuple)
    return matching


def _frequency_error(fitted: FittedModes) -> float:
    """The seed's ε (its Eq. 10) over all modes that have a model mode."""
    total = 0.0
    for data, match in zip(fitted.observations.data, _matching(fitted), strict=True):
        modes = fitted.problem.solution(data.configuration, fitted.posterior.x)
        on = match >= 0
        total += float(np.sum((np.exp(data.log_frequency[on]) / modes.frequency_hz[match[on]] - 1) ** 2))
    return total


def seed_route(
    rig: Rig, measured: Mapping[str, MeasuredModes], settings: FitSettings
) -> tuple[tuple[ErrorSweep, ...], StepwiseEstimate | None]:
    """The seed's error function over every free stiffness, each in the first configuration that depends on it."""
    sweeps: list[ErrorSweep] = []
    held: dict[str, float] = {}
    for p in rig.parameters.values():
        if not p.free or "@" in p.name or not 0 < p.minimum < p.maximum < np.inf:
            continue
        configuration = next((c for c in rig.configurations if c in measured and p.name in rig.used(c)), None)
        if configuration is None:
            continue
        frequency = measured[configuration].frequency_hz
        for count in mode_counts(frequency.size):
            sweeps.append(error_sweep(rig, configuration, p.name, frequency, count, settings, held))
        if sweeps:
            held[p.name] = sweeps[-1].minimum
    return tuple(sweeps), stepwise(rig, measured, settings) if rig.stiffness_steps else None
