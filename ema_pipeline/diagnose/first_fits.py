"""Where the fits of hypotheses begin, and the first fit of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.finals import PROMISING
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.score import Marginal, Score
from ema_pipeline.inference import Posterior, Residuals, Unknowns, same_matching
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.fitting import (
    QUICK,
    REFINED,
    Fit,
    Model,
    annealed,
    best_refined,
    nominal,
    refined,
    transferred,
    wide,
)
from ema_pipeline.processes import spread

Schedule = tuple[tuple[float, int], ...]

_SHORT = 8
"""Steps of a short fit."""
_UNPROMISING = 3
"""The same where sizes of a grid promise nothing."""
_AS_GOOD = 0.02
"""Log density by which a fit of no size may be behind the base model, which was fitted in more steps."""
CONTINUED = 20
"""The same where the start is good but for unknowns that are new."""
_HALF, _LITTLE = 1.0, 0.05
"""Largest unknown of a size, in units of its prior σ, from which a fit begins where half of what its score tells is
larger."""
_GRID = tuple(np.linspace(-2.0, 2.0, 9))
"""Unknowns of sizes, in units of their prior σ, at which an effect that adds modes is tried."""
_GRID_STARTS = 5
"""The best of these share the frequency of the added mode, whatever its mass: a support of 1.2 kg on a ring, which
gained 480, was reached from the third only."""
_GRID_HEAT = 30.0
"""Factor on the uncertainties there: two neighbours of the grid differ by a third in the frequency of an added mode."""
_SMALLEST = 0.003
_SIZES = (-15.0, -8.0, -4.0, -2.0, -1.0, _SMALLEST, 0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 15.0)
"""The same for effects of one size where measured modes have no partner: a size that gives them one may be far out, or
small where it lifts a mode from 0 Hz."""
_FROM_GRID: Schedule = ((5.0, 6), (1.0, 14))
_UNHEATED: Schedule = ((1.0, 6), (1.0, 14))
"""Where starts are given. Heated, the data weigh less than the prior, which takes the first size to nothing, where the
shape of a law (the yield of hysteresis) has no slope left."""


def short_fits(
    observations: Observations,
    base: Fit,
    models: Mapping[str, Model],
    promise: Mapping[str, Score],
    hypotheses: Sequence[Hypothesis],
    processes: int | None,
) -> list[tuple[Hypothesis, Posterior]]:
    """Fits of a few steps from the sizes that scores tell, best first, of hypotheses of one size."""
    scored = [
        h
        for h in hypotheses
        if h.label in promise and len(promise[h.label].size) == 1 and h.placed.effect.linear and not h.begun
    ]

    def fitted(hypothesis: Hypothesis) -> Posterior:
        score = promise[hypothesis.label]
        return _from_score(observations, base, models[hypothesis.label], hypothesis, score, _SHORT)

    found = list(zip(scored, spread(fitted, scored, processes), strict=True))
    return sorted(found, key=lambda pair: -pair[1].log_evidence)


@dataclass(frozen=True)
class Tried:
    """The best of some sizes of an effect, tried on a model whose parts are not bent to the data.

    Attributes
    ----------
    unknown : float
        Of the size.
    gain : float
        By how much the cost falls, at wide uncertainties, or that of modes without a partner, if this is more.
    pairs : float
        By how much the cost of modes without a partner falls, at plain uncertainties, with one of `tuned`.
    tuned : tuple of float
        Other sizes, which give a mode of the model the frequency of a measured one. Where nominal modes coincide, their
        shapes lie as they happen to, and other costs hardly tell sizes apart.
    """

    unknown: float
    gain: float
    pairs: float = 0.0
    tuned: tuple[float, ...] = ()


def tried_sizes(
    observations: Observations,
    base: Fit,
    models: Mapping[str, Model],
    hypotheses: Sequence[Hypothesis],
    processes: int | None,
) -> dict[str, Tried]:
    """What gives modes without a partner one: the best such size of every effect of one size that makes matters better.

    As good as a partner is that a mode of the model, which was not measured, leaves the band.
    """
    asked = [
        h
        for h in hypotheses
        if len(h.placed.effect.parameters) == 1
        and h.placed.effect.linear
        and not h.size_cannot_be_zero
        and not h.begun
    ]
    scatters = wide(observations)

    def best(hypothesis: Hypothesis) -> Tried:
        problem = models[hypothesis.label].problem(observations)
        unknowns = problem.unknowns
        begin = _unbent(unknowns, transferred(base.posterior, unknowns))
        at = unknowns.index[_first_size(hypothesis)]

        def at_size(size: float) -> NDArray[np.float64]:
            x = begin.copy()
            x[at] = size
            return x

        def compared(size: float) -> Residuals:
            return problem.residuals(at_size(size), scatters, heat=_GRID_HEAT, derivatives=False)

        if unknowns.clipped(at_size(0.0))[at]:  # it has no size of nothing
            return Tried(0.0, -np.inf)
        without = compared(0.0)
        tuned = [s for s in problem.tuned(begin, unknowns.names[at]) if unknowns.clipped(at_size(s))[at] == s]
        sizes = [s for s in _SIZES if unknowns.clipped(at_size(s))[at] == s] + tuned
        fewer = [s for s in sizes if problem.unpaired(at_size(s), scatters, _GRID_HEAT) < without.penalty]
        if not fewer:
            return Tried(0.0, -np.inf)
        least, size = min((compared(s).cost, s) for s in fewer)
        # what turns coinciding modes of nominal parts into each other, or apart, is no worse for that
        gain = max(without.cost, compared(_SMALLEST).cost) - least
        before, *after = (problem.unpaired(at_size(s), scatters, 1.0) for s in (0.0, *tuned))
        pairs = before - min(after, default=before)
        best_tuned = tuple(s for s, cost in zip(tuned, after, strict=True) if cost == before - pairs)
        return Tried(size, max(gain, without.penalty - compared(size).penalty), pairs, best_tuned)

    found = zip(asked, spread(best, asked, processes), strict=True)
    return {h.label: tried for h, tried in found if tried.gain > 0}


def first_fit(
    observations: Observations,
    base: Fit,
    models: Mapping[str, Model],
    promise: Mapping[str, Score],
    hypothesis: Hypothesis,
    near: bool = False,
) -> Posterior:
    """The fit begun at the size that its score tells; annealed where that makes matters worse.

    `near` is true where the base model has not bent anything to the data.
    """
    model, score = models[hypothesis.label], promise.get(hypothesis.label)
    begun = _begun(observations, base, model)
    if begun is not None:
        return begun
    found = []
    if score is not None and (len(score.size) == 1 or (near and hypothesis.has_direction)):
        found.append(_from_score(observations, base, model, hypothesis, score))
        if _no_worse(found[0], base, score):
            return found[0]
    elif near and hypothesis.size_cannot_be_zero:
        gain, x = _best_to_first_order(observations, base, model, hypothesis)
        if gain < PROMISING:
            return refined(observations, model, x, steps=_UNPROMISING).posterior
    found.append(annealed_fit(observations, base, models, promise, {}, hypothesis, near))
    return max(found, key=lambda p: p.log_evidence)


def annealed_fit(
    observations: Observations,
    base: Fit,
    models: Mapping[str, Model],
    promise: Mapping[str, Score],
    tried: Mapping[str, Tried],
    hypothesis: Hypothesis,
    near: bool = False,
) -> Posterior:
    """The fit annealed from several sizes, or begun where the data themselves tell it to."""
    model = models[hypothesis.label]
    begun = _begun(observations, base, model)
    if begun is not None:
        return begun
    schedule = _UNHEATED if hypothesis.begun else _FROM_GRID if hypothesis.size_cannot_be_zero else QUICK
    problem = model.problem(observations)
    begin = transferred(base.posterior, problem.unknowns)
    label = hypothesis.label
    starts = _starts(observations, problem, hypothesis, begin, promise.get(label), tried.get(label), near)
    if base.posterior.residuals.unexplained and not hypothesis.size_cannot_be_zero:
        starts += _from_nominal(problem, hypothesis, begin)
    found = [annealed(observations, model, starts, schedule)]
    if label in tried and tried[label].tuned:  # apart: while hot, sizes that do nothing cost less
        unbent, name = _unbent(problem.unknowns, begin), _first_size(hypothesis)
        starts = [problem.unknowns.with_values(unbent, {name: size}) for size in tried[label].tuned]
        found.append(annealed(observations, model, starts, schedule))
    return max((fit.posterior for fit in found), key=lambda p: p.log_evidence)


def continued_fit(
    observations: Observations,
    base: Fit,
    model: Model,
    before: Posterior,
    otherwise: Callable[[], Posterior],
) -> Posterior:
    """The fit begun where that to the same data with fewer unknowns ended; `otherwise` where that does not help."""
    unknowns = model.problem(observations).unknowns
    x = transferred(before, unknowns, transferred(base.posterior, unknowns))
    found = refined(observations, model, x, steps=CONTINUED).posterior
    if found.log_evidence > base.log_evidence:
        return found
    return max(found, otherwise(), key=lambda p: p.log_evidence)


def _begun(observations: Observations, base: Fit, model: Model) -> Posterior | None:
    """The fit begun where the data themselves tell it to; None where they do not."""
    problem = model.problem(observations)
    begin = transferred(base.posterior, problem.unknowns)
    begun = problem.begun(begin, base.posterior.scatters)
    return best_refined(observations, model, begun).posterior if begun else None


def _starts(
    observations: Observations,
    problem: EffectProblem,
    hypothesis: Hypothesis,
    begin: NDArray[np.float64],
    score: Score | None = None,
    tried: Tried | None = None,
    near: bool = False,
) -> list[NDArray[np.float64]]:
    """Points from which a hypothesis is fitted.

    A base model that fails has bent parts and channels to the data: a true effect is found from unbent ones; where it
    is `near`, its fit is as good a start. In forces in time it has bent everything, up to a fit that no true effect
    leads out of: there one fit begins where the base model's did. Usual sizes may be ten times too large; the one that
    a score tells is about right where the effect is.
    """
    if hypothesis.begun:
        sizes_known = [problem.unknowns.index[name] for name in problem.sizes]
        unbent = problem.start()
        unbent[sizes_known] = begin[sizes_known]
    else:
        unbent = _unbent(problem.unknowns, begin)
    sources = [begin] if near and not hypothesis.begun else [begin, unbent]
    if hypothesis.size_cannot_be_zero:
        plans = [(x, start) for x in sources for start in _best_of_grid(observations, problem, x, hypothesis)]
    else:
        plans = [(begin, start) for start in hypothesis.starts()]
        plans += [(x, start) for x in sources[1:] for start in hypothesis.starts()[:1]]
        if score is not None and len(score.size) == 1 and not hypothesis.begun:
            plans.append((begin, {_first_size(hypothesis): float(score.size[0])}))
        if tried is not None:
            plans.append((unbent, {_first_size(hypothesis): tried.unknown}))
    unknowns = problem.unknowns
    return [unknowns.clipped(unknowns.with_values(x, sizes)) for x, sizes in plans]


def _from_nominal(
    problem: EffectProblem, hypothesis: Hypothesis, begin: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """The first size at `nominal` values."""
    unknowns, sizes = problem.unknowns, hypothesis.starts()[0]
    return [unknowns.clipped(unknowns.with_values(x, sizes)) for x in nominal(problem, begin)]


def _from_score(
    observations: Observations,
    base: Fit,
    model: Model,
    hypothesis: Hypothesis,
    score: Score,
    steps: int = REFINED,
) -> Posterior:
    """The fit begun at half of the size that the score tells, or at a little where that makes matters worse.

    Where the base model has bent the very part that the effect changes, half of the size on top of it goes too far.
    """
    unknowns, placed = model.problem(observations).unknowns, hypothesis.placed
    at = [unknowns.index[placed.parameter_name(p.name)] for p in placed.effect.parameters]
    found = []
    for largest in (_HALF, _LITTLE):
        x = transferred(base.posterior, unknowns)
        x[at] = [float(np.clip(0.5 * score.size[0], -largest, largest)), *score.size[1:]]
        found.append(refined(observations, model, unknowns.clipped(x), steps=steps).posterior)
        if _no_worse(found[-1], base, score):
            break
    return max(found, key=lambda p: p.log_evidence)


def _no_worse(found: Posterior, base: Fit, score: Score) -> bool:
    """True where a fit makes matters no worse but by what the prior of sizes beside the first one costs."""
    return found.cost <= base.posterior.cost + 0.5 * float(score.size[1:] @ score.size[1:]) + _AS_GOOD


def _first_size(hypothesis: Hypothesis) -> str:
    """Name of the unknown of its first size, of most effects the only one."""
    return hypothesis.placed.parameter_name(hypothesis.placed.effect.parameters[0].name)


def _unbent(unknowns: Unknowns, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """With nothing that scatters bent to the data, (n,)."""
    return np.where([bool(s) for s in unknowns.scatter], 0.0, x)


def _best_to_first_order(
    observations: Observations, base: Fit, model: Model, hypothesis: Hypothesis
) -> tuple[float, NDArray[np.float64]]:
    """What sizes of the grid gain at most where all that is uncertain follows to first order, and all unknowns there.

    Where modes have other partners nothing is known of what follows.
    """
    problem, marginal, found = model.problem(observations), Marginal(base), base.posterior.residuals
    begin = transferred(base.posterior, problem.unknowns)
    best, at = -np.inf, begin
    for sizes in _grid(hypothesis):
        x = problem.unknowns.with_values(begin, sizes)
        there = problem.residuals(problem.unknowns.clipped(x), base.posterior.scatters, derivatives=False)
        as_before = same_matching(there.matching, found.matching)
        gain = marginal.gained(there.values - found.values) if as_before else found.cost - there.cost
        gain -= 0.5 * sum(u**2 for u in sizes.values())
        if gain > best:
            best, at = gain, x
    return best, problem.unknowns.clipped(at)


def _grid(hypothesis: Hypothesis) -> list[dict[str, float]]:
    """Unknowns of its sizes on a grid."""
    names = [hypothesis.placed.parameter_name(p.name) for p in hypothesis.placed.effect.parameters]
    return [dict(zip(names, values, strict=True)) for values in product(_GRID, repeat=len(names))]


def _best_of_grid(
    observations: Observations, problem: EffectProblem, begin: NDArray[np.float64], hypothesis: Hypothesis
) -> list[dict[str, float]]:
    """Sizes, by their unknowns, at which the modes that the effect adds lie nearest to measured ones."""
    scatters = wide(observations)
    tried = []
    for sizes in _grid(hypothesis):
        x = problem.unknowns.with_values(begin, sizes)
        found = problem.residuals(problem.unknowns.clipped(x), scatters, heat=_GRID_HEAT, derivatives=False)
        tried.append((found.cost, sizes))
    return [start for _, start in sorted(tried, key=lambda pair: pair[0])[:_GRID_STARTS]]
