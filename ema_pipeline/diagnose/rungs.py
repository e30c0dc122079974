"""Models from the base upwards, with their errors on data fitted and on data held out, all at the same scatters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.diagnose.heldout import held_out
from ema_pipeline.diagnose.types import EffectSize, Ladder, LearnedScatter, Rung
from ema_pipeline.effects.base import effect_of
from ema_pipeline.inference import Posterior
from ema_pipeline.inference.maximise import ANNEALING, anneal
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    at_scatters,
    averaged,
    best_refined,
    fit_base,
    learned,
    made_up_of,
    nominal,
    transferred,
    within_scatter,
)
from ema_pipeline.processes import spread

_CALCULATED_STD, _RUBBED_STD = 0.3, 0.6
"""1 σ, over a size that the motion in single hits tells, of what their calculation has wrong of it, and over a force
and its velocity, of friction: in a study ten others lay within 1.64 σ so, friction was half of the truth in half of
the tests."""


def rungs_of(observations: Observations, fits: Sequence[Fit], processes: int | None = 1) -> tuple[Rung, ...]:
    """Every fit as a rung, at the scatters of the last one; `processes` share them, None for one per processor.

    Nothing is held out that has no partner without the effects, as in the diagnosis.
    """
    scatters = fits[-1].posterior.scatters
    explained = observations.holding_out_explained(fits[0].posterior.residuals)

    def at(fit: Fit) -> Rung:
        return rung_at(explained, fit, scatters)

    return with_gains(list(spread(at, fits, processes, least=2)))


def with_gains(rungs: Sequence[Rung]) -> tuple[Rung, ...]:
    """The rungs with their log evidence counted from that of the first one."""
    base = rungs[0].log_evidence
    return tuple(replace(r, log_evidence=r.log_evidence - base) for r in rungs)


def rung_at(observations: Observations, fit: Fit, scatters: Mapping[str, float]) -> Rung:
    """One model of the ladder at given scatters, with its own log evidence, which is that of the whole fit.

    No part lies further out than parts scatter.
    """
    fit = at_scatters(observations, fit, scatters)
    evidence = fit.log_evidence
    problem, fit = fit.model.problem(observations), within_scatter(observations, fit)
    held = held_out(observations, fit)
    return Rung(
        effects=fit.model.labels,
        error=fit.posterior.error,
        heldout_error=held.error,
        chi2=float(fit.posterior.residuals.values @ fit.posterior.residuals.values),
        parameters=_stated(
            observations, fit.model, parameter_sizes(problem, averaged(observations, fit).posterior)
        ),
        log_evidence=evidence,
        unexplained=fit.posterior.residuals.unexplained,
        unknowns=fit.unknowns,
    )


def as_calculated(size: EffectSize) -> EffectSize:
    """A size that the motion in single hits tells, with what their calculation has wrong."""
    wrong = (_RUBBED_STD if size.unit in ("N", "m/s") else _CALCULATED_STD) * size.value
    return replace(size, std=float(np.hypot(size.std, wrong)))


def _stated(
    observations: Observations, model: Model, sizes: Mapping[str, EffectSize]
) -> dict[str, EffectSize]:
    nonlinear = {e.label for e in model.effects if not e.effect.linear and observations.linearised}
    return {
        name: as_calculated(size) if effect_of(name) in nonlinear else size for name, size in sizes.items()
    }


def parameter_sizes(problem: EffectProblem, posterior: Posterior) -> dict[str, EffectSize]:
    """Values of all parameters and effects' sizes with 1 σ."""
    values = problem.parameter_values(posterior.x)
    found = {}
    for name, value in values.items():
        i = posterior.unknowns.index.get(name)
        if i is None:
            continue
        size = problem.sizes.get(name)
        slope = abs(size.slope(float(posterior.x[i]))) if size is not None else abs(value)
        std = float(np.sqrt(posterior.of_sums([made_up_of(problem, name)])[0][0, 0]))
        unit = "" if size is None else size.parameter.unit
        found[name] = EffectSize(value, std * slope, unit, size is None or size.learned(posterior, i))
    return found


def make_ladder(observations: Observations, models: Sequence[Model]) -> Ladder:
    """The ladder of given models, each on top of the one before.

    Parameters
    ----------
    observations : Observations
    models : sequence of Model
        The base model first.
    """
    return ladder_of(observations, fits_of(observations, models))


def fits_of(observations: Observations, models: Sequence[Model], start: Fit | None = None) -> list[Fit]:
    """Fits of models, each begun at the one before; the first at `start`, a fit to the same data, if there is one."""
    fits = [fit_base(observations, models[0], start)]
    for model in models[1:]:
        fits.append(_best_of(observations, model, fits[-1]))
    fits[-1] = learned(observations, fits[-1])
    return fits


def ladder_of(
    observations: Observations, fits: Sequence[Fit], scatters: Mapping[str, float] | None = None
) -> Ladder:
    """The ladder of fits, all at given scatters, or at those of the last one."""
    if scatters:
        known = fits[-1].posterior.scatters
        fits = [
            *fits[:-1],
            at_scatters(observations, fits[-1], {n: scatters.get(n, s) for n, s in known.items()}),
        ]
    return Ladder(
        rungs_of(observations, fits),
        *noise(fits[-1]),
        note="",
        scatters=learned_scatters(observations, fits[-1]),
    )


def _best_of(observations: Observations, model: Model, before: Fit) -> Fit:
    """A model with one effect more, begun at several sizes of it."""
    problem = model.problem(observations)
    new = [n for n in problem.sizes if n not in before.posterior.unknowns.index]
    scatters = before.posterior.scatters
    begun = problem.begun(transferred(before.posterior, problem.unknowns, problem.start()), scatters)
    if begun:
        return best_refined(observations, model, begun, scatters)
    fits = []
    start = transferred(before.posterior, problem.unknowns, problem.start())
    plans = [(factor, start) for factor in (1.0, 0.3, -0.5)]
    if before.posterior.residuals.unexplained:
        plans += [(1.0, x) for x in nominal(problem, start)]
    for factor, begin in plans:
        x = begin.copy()
        for name in new:
            i = problem.unknowns.index[name]
            x[i] = factor * x[i] if x[i] else 0.3 * factor
        found = anneal(problem, before.posterior.scatters, problem.unknowns.clipped(x), ANNEALING)
        fits.append(Fit(model, found))
    return max(fits, key=lambda f: f.log_evidence)


def noise(fit: Fit) -> tuple[float, float, float]:
    """Scatter of frequency, damping and shapes beside the test's own; 0 where the data have none."""
    known = fit.posterior.scatters
    return (
        known.get("frequency_scatter", 0.0),
        known.get("damping_scatter", 0.0),
        known.get("shape_scatter", 0.0),
    )


def learned_scatters(observations: Observations, fit: Fit) -> tuple[LearnedScatter, ...]:
    """Every hyper-parameter as stated and as learned."""
    return tuple(
        LearnedScatter(s.name, s.title, s.default, fit.posterior.scatters[s.name])
        for s in observations.scatters.values()
    )
