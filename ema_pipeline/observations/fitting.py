"""Fits of one model to the data, begun at what other fits have learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.library import depends_on_level, parse_effect
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.inference import (
    Bounded,
    Posterior,
    Unknowns,
    anneal,
    averaged_over_others,
    beyond,
    descend,
    learn,
    reach,
    widened,
)
from ema_pipeline.inference.bounded import FURTHEST
from ema_pipeline.inference.maximise import ANNEALING
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.parts import DIRECTION_SCATTER, FREE_STD, MASS_SCATTER, PART_SCATTER
from ema_pipeline.processes import spread
from ema_pipeline.rigs.types import Rig

PARTS = (PART_SCATTER, MASS_SCATTER, DIRECTION_SCATTER)
"""Scatters of what the model is made of. A channel may be off by any factor, the model is none the worse for it."""
_MOST_ESCAPES = 4
"""Barriers that a fit is led past, one after the other."""

QUICK = ((30.0, 5), (5.0, 5), (1.0, 8))
"""Annealing of a hypothesis that begins at the base model's fit."""

REFINED = 12
"""Steps of a fit from a good start."""

_RACED = 2
"""Starts that are annealed to the end."""
_RACE_STEPS = 6
"""Steps from each of several good starts, after which the best goes on."""
_MET = 0.05
"""Distance, in units of the prior 1 σ, up to which two fits have met."""

_FAR = 0.5
"""Prior σ from its nominal value beyond which a free parameter is far from it."""
_FREE_STARTS = (0.0, 1.2, -1.2)
"""Start values of the logarithm of a free parameter: a decade to either side of its nominal value is reached."""
_MOST_FREE = 2
_ALONE = 0.4
"""Prior 1 σ of a family from which several starts are worth their time."""


@dataclass(frozen=True)
class Model:
    """Effects on top of the rig, with the prior 1 σ of their sizes by ``id@place.name``."""

    effects: tuple[PlacedEffect, ...] = ()
    scales: Mapping[str, float] = field(default_factory=dict)
    _known: list[tuple[Observations, EffectProblem]] = field(default_factory=list, compare=False, repr=False)

    def plus(self, placed: PlacedEffect, scales: Mapping[str, float]) -> Model:
        """With one effect more."""
        return Model((*self.effects, placed), {**self.scales, **scales})

    @property
    def labels(self) -> tuple[str, ...]:
        """``id@place`` of the effects."""
        return tuple(e.label for e in self.effects)

    def problem(self, observations: Observations) -> EffectProblem:
        """The problem of fitting it to data; that of the last data is cached, since it takes as long as some steps."""
        if not self._known or self._known[0][0] is not observations:
            self._known[:] = [(observations, observations.problem(self.effects, self.scales))]
        return self._known[0][1]


def model_with(
    labels: Sequence[str],
    rig: Rig,
    library: Mapping[str, Effect],
    with_hits: bool = False,
) -> Model:
    """The base model with effects ``id@place``.

    Their sizes have the range and the prior 1 σ that the rig without them gives, as in the diagnosis that found them;
    where a place is on what an earlier effect adds, those of the rig with that one.

    Parameters
    ----------
    labels : sequence of str
    rig : Rig
        Without the effects.
    library : mapping of str to Effect
    with_hits : bool
        False leaves out effects that depend on the force level: modes of one level do not show them.
    """
    model = Model()
    for label in labels:
        if not with_hits and depends_on_level(label, library):
            continue
        current = rig_with_effects(rig, model.labels, library)
        placed = parse_effect(label, current, library=library)
        assemblies = (r.assembly(c) for r in (rig, current) for c in r.configurations)
        host = next((a for a in assemblies if placed.effect.fits(a, placed.place)), None)
        if host is None:
            model = model.plus(placed, {})
            continue
        possible, scales = placed.hosted(host)
        model = model.plus(possible, {placed.parameter_name(k): v for k, v in scales.items()})
    return model


@dataclass(frozen=True)
class Fit:
    """A model and its posterior."""

    model: Model
    posterior: Posterior

    @property
    def log_evidence(self) -> float:
        """Of the model, up to a constant of the data."""
        return self.posterior.log_evidence

    @property
    def unknowns(self) -> dict[str, float]:
        """Everything uncertain as it was fitted, by name."""
        return {n: float(v) for n, v in zip(self.posterior.unknowns.names, self.posterior.x, strict=True)}


def transferred(
    posterior: Posterior, unknowns: Unknowns, otherwise: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Values of unknowns that have the same names, `otherwise` for the rest, or zero, (n,)."""
    x = np.zeros(len(unknowns)) if otherwise is None else otherwise.copy()
    known = posterior.unknowns.index
    for i, name in enumerate(unknowns.names):
        if name in known:
            x[i] = posterior.x[known[name]]
    return unknowns.clipped(x)


def nominal(problem: EffectProblem, x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """A point with everything but the effects' sizes at its nominal value, (n,), where a free parameter is far from it.

    A model that has lost a measured mode may have moved one so far for the sake of the others that no fit leads back: a
    soil ten times too stiff took the lowest mode out of reach.
    """
    unknowns, found = problem.unknowns, problem.start()
    known = [unknowns.index[name] for name in problem.sizes]
    found[known] = x[known]
    free = (unknowns.std >= FREE_STD[0]) & np.array([not s for s in unknowns.scatter])
    far = np.any(np.abs(found - x)[free] > _FAR * unknowns.std[free])
    return [found] if far else []


def made_up_of(problem: EffectProblem, name: str) -> dict[str, float]:
    """Unknowns whose weighted sum is the unknown of a parameter: its own, and that of its only part."""
    part, power = problem.sole_parts.get(name, (name, 1.0))
    return {name: 1.0, part: power}


def wide(observations: Observations) -> dict[str, float]:
    """The scatters at which fits begin."""
    return {name: s.start for name, s in observations.scatters.items()}


def met(found: Posterior, x: NDArray[np.float64]) -> bool:
    """True where a fit has come to `x`, so that it would end in the same place from there."""
    return bool(np.all(np.abs(found.x - x) <= _MET * found.prior_std))


def annealed(
    observations: Observations,
    model: Model,
    starts: Sequence[NDArray[np.float64]],
    schedule: Sequence[tuple[float, int]],
) -> Fit:
    """A fit from far off, at wide scatters: the best of those begun at `starts`.

    After the first steps of annealing only the most promising starts that did not meet go on.
    """
    problem, scatters = model.problem(observations), wide(observations)
    hot = [anneal(problem, scatters, x, schedule[:1]) for x in starts]
    kept: list[Posterior] = []
    for found in sorted(hot, key=lambda p: p.cost):
        if len(kept) < _RACED and not any(met(found, k.x) for k in kept):
            kept.append(found)
    cooled = [Fit(model, anneal(problem, scatters, p.x, schedule[1:])) for p in kept]
    return max(cooled, key=lambda f: f.log_evidence)


def refined(
    observations: Observations,
    model: Model,
    start: NDArray[np.float64],
    scatters: Mapping[str, float] | None = None,
    steps: int = REFINED,
) -> Fit:
    """A fit from a good start."""
    problem = model.problem(observations)
    return Fit(model, descend(problem, scatters or wide(observations), start, steps=steps))


def best_refined(
    observations: Observations,
    model: Model,
    starts: Sequence[NDArray[np.float64]],
    scatters: Mapping[str, float] | None = None,
    processes: int | None = 1,
) -> Fit:
    """A fit from the best of some starts, after some steps from each, which processes share."""
    if len(starts) == 1:
        return refined(observations, model, starts[0], scatters)

    def short(x: NDArray[np.float64]) -> Posterior:
        return refined(observations, model, x, scatters, _RACE_STEPS).posterior

    best = max(spread(short, starts, processes), key=lambda p: p.log_evidence)
    return refined(observations, model, best.x, scatters)


def freed(observations: Observations, fit: Fit) -> Fit:
    """The fit led past barriers before which it is stuck, as long as that makes it better."""
    problem = fit.model.problem(observations)
    for _ in range(_MOST_ESCAPES):
        p = fit.posterior
        if not np.isfinite(p.cost):  # no admissible model at the start: nothing to lead anywhere
            break
        better = None
        for start in problem.escapes(p.x, p.scatters, p.residuals):
            found = descend(problem, p.scatters, start)
            if found.cost < p.cost - 1.0 and (better is None or found.cost < better.cost):
                better = found
        if better is None:
            break
        fit = replace(fit, posterior=better)
    return fit


def learned(observations: Observations, fit: Fit, past_barriers: bool = True) -> Fit:
    """The fit with scatters learned, beginning at the stated ones where none were learned before."""
    problem = fit.model.problem(observations)
    known = fit.posterior.scatters
    scatters = {n: s.default if known[n] == s.start else known[n] for n, s in observations.scatters.items()}
    start = descend(problem, scatters, fit.posterior.x, steps=10)
    found = replace(fit, posterior=learn(problem, start, observations.scatters))
    if not past_barriers:
        return found
    free = freed(observations, found)  # a barrier that was low while scatters were wide
    if free is found:
        return found
    return replace(fit, posterior=learn(problem, free.posterior, observations.scatters))


def at_scatters(observations: Observations, fit: Fit, scatters: Mapping[str, float]) -> Fit:
    """The fit at given scatters, so that the errors of several models compare."""
    return refined(observations, fit.model, fit.posterior.x, scatters)


def averaged(observations: Observations, fit: Fit) -> Fit:
    """The fit at scatters that hold how well they are known, for sizes whose intervals are true; these averaged over
    everything else.
    """
    wide = at_scatters(observations, fit, widened(fit.posterior, observations.scatters))
    wide = within_scatter(observations, wide)
    if observations.slow:
        return wide
    problem = fit.model.problem(observations)
    bounded = Bounded(problem, part_reach(observations, wide.posterior))
    return replace(wide, posterior=averaged_over_others(bounded, wide.posterior, problem.sizes))


def part_reach(
    observations: Observations, found: Posterior, furthest: float = FURTHEST, kinds: Sequence[str] = PARTS
) -> dict[str, float]:
    """How far every part may deviate from its like, by name, see `reach`."""
    known = {n: observations.scatters[n].default for n in kinds if n in observations.scatters}
    return reach(found, known, furthest)


def unbent(observations: Observations, fit: Fit) -> bool:
    """True where no part lies further out than parts scatter: on top of one that does, every effect promises much."""
    return not np.any(beyond(fit.posterior, part_reach(observations, fit.posterior)))


def within_scatter(observations: Observations, fit: Fit) -> Fit:
    """The fit with no part further out than the others of its kind tell, and their scatter; the same where none is.

    A model that bends one part ten times as far as the others follows the data, but it is no longer the one that was
    meant.
    """
    p = fit.posterior
    most = part_reach(observations, p)
    far = np.flatnonzero(beyond(p, most))
    if not len(far):
        return fit
    scatters = dict(p.scatters)
    for i in far:
        kind, name = p.unknowns.scatter[i], p.unknowns.names[i]
        scatters[kind] = min(scatters[kind], most[name] / (FURTHEST * p.unknowns.std[i]))
    return replace(fit, posterior=descend(Bounded(fit.model.problem(observations), most), scatters, p.x))


def fit_base(observations: Observations, model: Model, start: Fit | None = None) -> Fit:
    """Annealed fit of a model, from several values of what is free."""
    problem = model.problem(observations)
    begin = problem.start()
    if start is not None:
        begin = transferred(start.posterior, problem.unknowns, begin)
    free = [i for i, s in enumerate(problem.unknowns.std) if not problem.unknowns.scatter[i] and s >= _ALONE]
    free = [i for i in free if problem.unknowns.names[i] not in problem.sizes][:_MOST_FREE]
    starts = []
    for values in product(_FREE_STARTS, repeat=0 if start is not None else len(free)):
        x = begin.copy()
        x[free[: len(values)]] += values
        starts.append(x)
    return freed(observations, annealed(observations, model, starts, ANNEALING))
