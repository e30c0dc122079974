"""The best hypotheses with scatters of their own, learned for each of them and for the base model.

Beside scatters that were learned for one of them, others are compared unfairly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ranked import Ranked, Ranking, unbeaten
from ema_pipeline.diagnose.score import scores
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    learned,
    met,
    refined,
    transferred,
    within_scatter,
)
from ema_pipeline.observations.mode_rows import SHAPE
from ema_pipeline.processes import spread

FINALISTS = 5
"""Hypotheses for which the scatters are learned, if they gain anything at wide ones."""
_AT_LEAST = 3
"""The same whatever they gain."""
_TIED, _MOST = 3.0, 16
"""Log evidence behind the best within which others may be as good at learned scatters, and how many are finalists then:
in gear trains of which one mode was lifted from 0 Hz, eleven springs lay within 2.7, and fifteen within 3.0."""
_LINEAR = 2
"""The best linear effects are finalists among whatever others: a planet's bearing that gained 73 was thirteenth, behind
cubic springs, and explained all at learned scatters."""
PROMISING = 1.0
"""Log evidence that is something: a third of what a claim needs."""
_FURTHER = 3
"""Finalists beside these that promise something at learned scatters."""
_TAKEN_UP = 2.0
"""Learned scatter of shapes over its least, from which it may hold what is missing."""
_BETTER = 0.05
"""Log evidence by which a start must lead a fit to be followed."""
_ALIKE = 0.05
"""Difference of the logarithms of two learned scatters that says nothing."""
_WORTH = 2
"""Fits with scatters to be learned, which take longest, from which processes are worth it."""


def spread_fits(
    job: Callable[[Fit], Posterior], fits: Sequence[Fit], processes: int | None, least: int = 4
) -> list[Fit]:
    """Better fits of the same models; only posteriors go between processes, a user's effects cannot."""
    return [Fit(fit.model, p) for fit, p in zip(fits, spread(job, fits, processes, least), strict=True)]


def leading(order: Sequence[tuple[Hypothesis, Fit]], base: Fit) -> list[tuple[Hypothesis, Fit]]:
    """What is a finalist by its fit at wide scatters, best first."""
    gaining = [pair for pair in order[_AT_LEAST:FINALISTS] if pair[1].log_evidence > base.log_evidence]
    least = max([base.log_evidence + PROMISING, *(fit.log_evidence - _TIED for _, fit in order[:1])])
    tied = [pair for pair in order[FINALISTS:_MOST] if pair[1].log_evidence > least]
    # laws at many places that gain alike leave room for what gains most beside them
    linear = [
        pair for pair in order if pair[0].placed.effect.linear and pair[1].log_evidence > base.log_evidence
    ]
    best = [*order[:_AT_LEAST], *gaining, *tied]
    return [*best, *(pair for pair in linear[:_LINEAR] if not any(pair is one for one in best))]


def promising_fits(
    observations: Observations,
    settled: Fit,
    hypotheses: Sequence[Hypothesis],
    models: Mapping[str, Model],
    count: int,
    processes: int | None,
) -> list[tuple[Hypothesis, Fit]]:
    """What promises most on top of the base model with learned scatters, begun at the size of its score.

    At wide scatters an effect that moves frequencies by a permille gains nothing.
    """
    found = []
    best = sorted(scores(observations, settled, hypotheses, models, processes), key=lambda s: -s.gain)
    chosen = best[:count]  # what the scatters took up promises little, and gains it back
    chosen += [score for score in best[count:_FURTHER] if score.gain > PROMISING]
    for score in chosen:
        model = models[score.hypothesis.label]
        unknowns = model.problem(observations).unknowns
        x = transferred(settled.posterior, unknowns)
        placed = score.hypothesis.placed
        for parameter, size in zip(placed.effect.parameters, score.size, strict=True):
            x[unknowns.index[placed.parameter_name(parameter.name)]] = size
        fit = refined(observations, model, unknowns.clipped(x), settled.posterior.scatters)
        found.append((score.hypothesis, fit))
    return found


def with_promising(
    observations: Observations,
    wide: Fit,
    ranking: Ranking,
    hypotheses: Sequence[Hypothesis],
    models: Mapping[str, Model],
    processes: int | None,
) -> Ranking:
    """The ranking with what promises and gains something beside its learned scatters, and was behind at wide ones.

    On top of a base model that is bent to the data little does, so there it has to beside a model that is not.

    Parameters
    ----------
    wide : Fit
        The base model at wide scatters, beside which all but the finalists are.
    """
    base, straight = ranking.base, within_scatter(observations, ranking.base)
    taken = {r.hypothesis.label for r in ranking.ranked if r.final}
    others = [h for h in hypotheses if h.label not in taken]
    found = promising_fits(observations, straight, others, models, 0, processes)
    more = [(h, fit) for h, fit in found if fit.log_evidence > straight.log_evidence + PROMISING]
    if not more:
        return ranking
    order = [(r.hypothesis, r.fit) for r in ranking.ranked]
    return finals_of(observations, wide, order, more, processes, (base,), past_barriers=False)


def narrowed(observations: Observations, settled: Fit) -> Fit | None:
    """The base model at a scatter of shapes half the way to its least; None where it is near it.

    What is missing may have been learned as scatter of shapes: a spring of 171 kN/m between the first and the fifth of
    six masses gained nothing beside shapes that scatter by 0.006, and 26 once that was learned anew with it.
    """
    shapes, scatters = observations.scatters.get(SHAPE), settled.posterior.scatters
    if shapes is None or scatters[SHAPE] <= _TAKEN_UP * shapes.least * shapes.default:
        return None
    narrow = float(np.sqrt(shapes.least * shapes.default * scatters[SHAPE]))
    return refined(observations, settled.model, settled.posterior.x, {**scatters, SHAPE: narrow})


def finals_of(
    observations: Observations,
    base: Fit,
    order: Sequence[tuple[Hypothesis, Fit]],
    promising: Sequence[tuple[Hypothesis, Fit]],
    processes: int | None,
    known: Sequence[Fit],
    past_barriers: bool,
) -> Ranking:
    """Scatters learned for the base model and the best hypotheses, each from what the others know.

    `known` are fits of the base model whose scatters are learned already. Fits are led past barriers, but for those
    that begin beside a base model that was.
    """
    best = leading(order, base)
    rest = order[len(best) :]
    near = unbeaten(best, lambda pair: pair[1].log_evidence)
    far = best[len(near) :]
    finalists = [*near, *promising]
    own = [base] if past_barriers else []
    led = [*own, *(fit for _, fit in finalists)]
    asked = [*((fit, past_barriers) for fit in led), *((fit, False) for _, fit in far)]
    found = _learned_each(observations, asked, processes)
    bases = [*found[: len(own)], *known]
    first = [max(bases, key=lambda f: f.log_evidence), *found[len(own) : len(led)]]
    beaten = found[len(led) :]
    leaders = sorted(first[1:], key=lambda f: -f.log_evidence)
    job = partial(_crossed, observations, (first[0], *leaders[:2]))
    final_base, *again = spread_fits(job, first, processes, _WORTH)
    ranked = [
        Ranked(hypothesis, fit, fit.log_evidence - final_base.log_evidence, True)
        for (hypothesis, _), fit in zip((*finalists, *far), (*again, *beaten), strict=True)
    ]
    best_of_each = {r.hypothesis.label: r for r in sorted(ranked, key=lambda r: r.gain)}
    finals = sorted(best_of_each.values(), key=lambda r: -r.gain)
    least = finals[-1].gain if finals else 0.0
    taken = {r.hypothesis.label for r in finals}
    # An effect that is no finalist was behind at wide scatters; it cannot lead at learned ones.
    others = [
        Ranked(hypothesis, fit, min(fit.log_evidence - base.log_evidence, least), False)
        for hypothesis, fit in rest
        if hypothesis.label not in taken
    ]
    return Ranking(final_base, (*finals, *others), observations.linearised)


def _learned_each(
    observations: Observations, asked: Sequence[tuple[Fit, bool]], processes: int | None
) -> list[Fit]:
    """Fits with their scatters learned, those with True led past barriers as well."""

    def job(one: tuple[Fit, bool]) -> Posterior:
        fit, past_barriers = one
        return learned(observations, fit, past_barriers).posterior

    learned_ones = spread(job, asked, processes, _WORTH)
    return [Fit(fit.model, p) for (fit, _), p in zip(asked, learned_ones, strict=True)]


def _crossed(observations: Observations, sources: Sequence[Fit], fit: Fit) -> Posterior:
    """The fit begun again at what others know, scatters included, and learned from there where that is better."""
    best = fit
    for source in sources:
        if source is fit:
            continue
        scatters, x = source.posterior.scatters, known_from(observations, fit.model, source, fit)
        if met(best.posterior, x) and _alike(best.posterior.scatters, scatters):
            continue
        start = refined(observations, fit.model, x, scatters, steps=10)
        here = refined(observations, fit.model, best.posterior.x, scatters, steps=4)
        if start.log_evidence > here.log_evidence + _BETTER:
            again = learned(observations, start, past_barriers=False)
            best = max(best, again, key=lambda f: f.log_evidence)
    return best.posterior


def _alike(some: Mapping[str, float], others: Mapping[str, float]) -> bool:
    """True where no scatter is another one."""
    return all(abs(np.log(others[name] / value)) < _ALIKE for name, value in some.items())


def known_from(observations: Observations, model: Model, source: Fit, sizes: Fit) -> np.ndarray:
    """Everything that `source` knows, and the effects' sizes of `sizes`."""
    problem = model.problem(observations)
    x = transferred(sizes.posterior, problem.unknowns)
    moved = transferred(source.posterior, problem.unknowns, x)
    for name in problem.sizes:
        i = problem.unknowns.index[name]
        if name in sizes.posterior.unknowns.index:
            moved[i] = x[i]
    return moved
