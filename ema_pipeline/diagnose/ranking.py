"""Every hypothesis fitted on top of the current model, and ranked by its evidence.

Most wrong names come from local optima: if the base fit is stuck in one, any hypothesis that escapes it appears to gain
evidence. So fits are annealed, and the base and every hypothesis are begun again from the best values known of all
else.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from ema_pipeline.diagnose.first_fits import (
    Tried,
    annealed_fit,
    continued_fit,
    first_fit,
    short_fits,
    tried_sizes,
)
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.parallel import spread
from ema_pipeline.diagnose.score import UNSEEN, Score, scores
from ema_pipeline.diagnose.settings import MOST_UNEXPLAINED
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import (
    Fit,
    Model,
    freed,
    learned,
    refined,
    transferred,
    unbent,
)
from ema_pipeline.observations.mode_rows import SHAPE

T = TypeVar("T")
Progress = Callable[[float, str], None]

FINALISTS = 5
"""Hypotheses for which the scatters are learned."""
_BEATEN = 200.0
"""Log evidence behind the best hypothesis from which another one cannot catch up: it is not begun again."""
_SCREENED = 14
"""Hypotheses of one kind, generic or the rig's own, best first by their score, that are fitted in full."""
_SCREENED_LAWS = 24
"""The same of nonlinear laws in forces in time, where the base model fails: their score is that of a small size on top
of a model that is bent to the data, and put a cubic spring of a chain of three, which explained all, fifteenth. Such a
chain has eighteen of one size."""
_ANNEALED = 16
"""Hypotheses, best first by a short fit, that are fitted in full where the base model fails, or is bent to the data;
beside them those of which some size gives modes without a partner one. What led in the end was among the first eight of
some sixty, or among these."""
_FIRST = 24
"""Hypotheses of one size that are annealed first where a measured mode has no partner, and those that are begun again
where the base model is bent to the data."""
_PAIRING = 8
"""Hypotheses that are annealed since one of some sizes explains measured modes that have no partner."""
_ALL = 0.5
"""Error at wide scatters, which is 0.3 on rigs without fault, up to which a model explains all."""
_UNPROMISING = 6
"""The same where the score promises nothing and the base model is near, so that a fit gains what its score says to some
tenths: more than `FINALISTS`, so that the reader sees what comes next."""
_PROMISING = 1.0
"""Log evidence that is something: a third of what a claim needs."""
_FURTHER = 3
"""Finalists beside these that promise something at learned scatters."""
_TAKEN_UP = 2.0
"""Learned scatter of shapes over its least, from which it may hold what is missing."""
CONTENDERS = 12
"""Hypotheses that are worth a second refinement."""
_BETTER = 0.05
"""Log evidence by which a start must lead a fit to be followed."""
_EXPLAINED = 1.3
"""Error up to which the base model is near enough for hypotheses to begin at its fit."""


@dataclass(frozen=True)
class Ranked:
    """One hypothesis on top of the model.

    Attributes
    ----------
    hypothesis : Hypothesis
    fit : Fit
    gain : float
        Log evidence against the model without it, both with learned scatters where it is a finalist.
    final : bool
        True where its scatters were learned.
    """

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    final: bool


@dataclass(frozen=True)
class Ranking:
    """The current model, and all hypotheses by evidence.

    Attributes
    ----------
    base : Fit
        With learned scatters.
    ranked : tuple of Ranked
        Best first.
    linearised : bool
        True where equivalent linearisation alone tells what effects do that depend on the amplitude.
    """

    base: Fit
    ranked: tuple[Ranked, ...]
    linearised: bool = False

    @property
    def unpaired(self) -> float:
        """Least that modes without a partner cost, over all hypotheses."""
        return min((r.fit.posterior.residuals.penalty for r in self.ranked), default=0.0)


def rank(
    observations: Observations,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    processes: int | None = 1,
    progress: Progress = lambda share, text: None,
    further: int = 0,
    unpaired: float = 0.0,
    before: Mapping[str, Posterior] | None = None,
) -> Ranking:
    """Fit every hypothesis and rank it.

    Parameters
    ----------
    observations : Observations
    base : Fit
        The current model, from `fit_base`.
    hypotheses : sequence of Hypothesis
    processes : int
        Processes that share the fits, None for one per processor; the result does not depend on their number.
    progress : callable
    further : int
        Finalists that promise most beside learned scatters, which may be far narrower than those begun with.
    unpaired : float
        What modes without a partner cost whatever was added in an earlier ranking: no reason to search further, unless
        they are so many that the model does not explain the data.
    before : dict of str to Posterior, optional
        Fits of hypotheses to the same data with fewer unknowns, from which theirs are begun.
    """
    models = {h.label: base.model.plus(h.placed, h.scales) for h in hypotheses}
    promise = {s.hypothesis.label: s for s in scores(observations, base, hypotheses, models, processes)}
    residuals = base.posterior.residuals
    lost = residuals.penalty > (unpaired if residuals.unexplained <= MOST_UNEXPLAINED else 0.0)
    tried = tried_sizes(observations, base, models, hypotheses, processes) if lost else {}
    unseen = {label for label, score in promise.items() if score.std >= UNSEEN} - set(tried)
    hypotheses = [h for h in hypotheses if h.label not in unseen]
    stuck = lost or base.posterior.error > _EXPLAINED
    settled = None if stuck else learned(observations, base)
    near = settled is not None and unbent(observations, settled)
    pairing = _pairing(tried)
    among = _screened(hypotheses, promise, near)
    chosen = [h for h in hypotheses if h in among or h.label in pairing]
    earlier = before or {}

    def job(hypothesis: Hypothesis) -> Posterior:
        if stuck:
            anew = partial(annealed_fit, observations, base, models, promise, tried, hypothesis)
        else:
            anew = partial(first_fit, observations, base, models, promise, hypothesis)
        label = hypothesis.label
        if label not in earlier:
            return anew()
        return continued_fit(observations, base, models[label], earlier[label], anew)

    short = partial(short_fits, observations, base, models, promise)
    known: dict[str, Posterior] = {}
    if not near:
        # A few steps do not lead a mode of the model to a measured one that has no partner yet.
        leads = {label for label, one in tried.items() if one.gain > _PROMISING}
        behind = short(chosen, processes)[_ANNEALED:]
        known |= {h.label: posterior for h, posterior in behind if h.label not in leads}
    decided = False
    left = [h for h in chosen if h.label not in known]
    for batch in _batches(left, promise if lost else {}, pairing):
        if decided:
            known |= {h.label: posterior for h, posterior in short(batch, processes)}
        asked = [h for h in batch if h.label not in known]
        for hypothesis, posterior in zip(asked, spread(job, asked, processes), strict=True):
            known[hypothesis.label] = posterior
            progress(0.6 * len(known) / len(chosen), hypothesis.label)
        decided = lost and any(_decides(p, base) for p in known.values())
    found = {h.label: (h, Fit(models[h.label], known[h.label])) for h in chosen}
    if not near and not decided:
        again = found if stuck else _contenders(found, _FIRST)
        base, found = _begun_again(observations, base, found, processes, again, steps=5)
    found = _bettered(found, _contenders(found), partial(_free, observations), processes)
    base, found = _begun_again(observations, base, found, processes, _contenders(found), steps=12)
    progress(0.8, "scatter of parts and channels")
    order = sorted(found.values(), key=lambda pair: -pair[1].log_evidence)
    others = [h for h in hypotheses if h.label not in {best.label for best, _ in order[:FINALISTS]}]
    if settled is None:
        ranking = _finals(observations, base, order, (), processes, (), past_barriers=True)
        return _with_promising(observations, base, ranking, hypotheses, models, processes)
    promising = _promising(observations, settled, others, models, further, processes) if near else []
    bases = [settled] if near else []
    narrow = _narrowed(observations, settled)
    if narrow is not None:
        promising += _promising(observations, narrow, hypotheses, models, 0, processes)
        bases.append(learned(observations, narrow, past_barriers=False))
    return _finals(observations, base, order, promising, processes, bases, past_barriers=not near)


def _screened(hypotheses: Sequence[Hypothesis], promise: Mapping[str, Score], near: bool) -> list[Hypothesis]:
    """The rig's own hypotheses, and the generic ones that promise most.

    Near the base model the score tells of the rig's own as well: those that promise nothing are left out, too. An
    effect of several sizes (hysteresis) shows its kind at a finite size only, of which a score knows nothing.
    """
    out: set[str] = set()
    scored = [h for h in hypotheses if len(h.placed.effect.parameters) == 1 and h.label in promise]
    if not near:
        laws = [h.label for h in scored if h.begun and not h.placed.effect.linear]
        out |= set(sorted(laws, key=lambda label: -promise[label].gain)[_SCREENED_LAWS:])
        scored = [h for h in scored if h.label not in laws]
    for generic in (True, False) if near else (True,):
        order = sorted((h for h in scored if h.generic is generic), key=lambda h: -promise[h.label].gain)
        out |= {h.label for h in order[_SCREENED:]}
        if near:
            out |= {h.label for h in order[_UNPROMISING:] if promise[h.label].gain < _PROMISING}
    return [h for h in hypotheses if h.label not in out]


def _pairing(tried: Mapping[str, Tried]) -> set[str]:
    """Hypotheses of which some size gives modes without a partner one, the best of them."""
    return set(sorted(tried, key=lambda label: -tried[label].gain)[:_PAIRING])


def _batches(
    hypotheses: Sequence[Hypothesis], promise: Mapping[str, Score], first: Collection[str]
) -> list[list[Hypothesis]]:
    """Those that promise most, those of `first`, or those whose score says nothing; and the others."""
    told = [
        h
        for h in hypotheses
        if h.label in promise and h.label not in first and len(h.placed.effect.parameters) == 1
    ]
    later = sorted(told, key=lambda h: -promise[h.label].gain)[_FIRST:]
    return [[h for h in hypotheses if h not in later], [h for h in hypotheses if h in later]]


def _decides(found: Posterior, base: Fit) -> bool:
    """True where one hypothesis explains all that the base model does not: no other one can lead it."""
    return found.error < _ALL and found.log_evidence > base.log_evidence + _BEATEN


Found = dict[str, tuple[Hypothesis, Fit]]


def _begun_again(
    observations: Observations,
    base: Fit,
    found: Found,
    processes: int | None,
    contenders: Collection[str],
    steps: int,
) -> tuple[Fit, Found]:
    """The base model and some hypotheses, begun at what the best of all knows of everything else."""
    top = max((f for _, f in found.values()), key=lambda f: f.log_evidence, default=base)
    again = refined(observations, base.model, _on(observations, base.model, top, base), steps=20)
    if again.log_evidence > base.log_evidence:
        base = again
    job = partial(_better, observations, (base, top), steps)
    return base, _bettered(found, contenders, job, processes)


def _contenders(found: Found, most: int = CONTENDERS) -> list[str]:
    """The best hypotheses, and none that is beaten."""
    best = sorted(found, key=lambda label: -found[label][1].log_evidence)[:most]
    return unbeaten(best, lambda label: found[label][1].log_evidence)


def unbeaten(best_first: Sequence[T], evidence: Callable[[T], float]) -> list[T]:
    """Those that can catch up with the first one."""
    return [one for one in best_first if evidence(one) >= evidence(best_first[0]) - _BEATEN]


def _bettered(
    found: Found, contenders: Collection[str], job: Callable[[Fit], Posterior], processes: int | None
) -> Found:
    """The hypotheses, some of them with what `job` makes of their fits."""
    items = [found[label] for label in contenders]
    better = _spread_fits(job, [fit for _, fit in items], processes)
    return found | {h.label: (h, fit) for (h, _), fit in zip(items, better, strict=True)}


def _free(observations: Observations, fit: Fit) -> Posterior:
    """The fit led past barriers before which it is stuck."""
    return freed(observations, fit).posterior


def _on(observations: Observations, model: Model, source: Fit, sizes: Fit) -> np.ndarray:
    """Everything that `source` knows, and the effects' sizes of `sizes`."""
    problem = model.problem(observations)
    x = transferred(sizes.posterior, problem.unknowns)
    moved = transferred(source.posterior, problem.unknowns, x)
    for name in problem.sizes:
        i = problem.unknowns.index[name]
        if name in sizes.posterior.unknowns.index:
            moved[i] = x[i]
    return moved


def _better(observations: Observations, sources: Sequence[Fit], steps: int, fit: Fit) -> Posterior:
    best = fit
    for source in sources:
        x = _on(observations, fit.model, source, fit)
        if np.allclose(x, best.posterior.x):
            continue
        again = refined(observations, fit.model, x, steps=steps)
        if again.log_evidence > best.log_evidence:
            best = again
    return best.posterior


def _spread_fits(job: Callable[[Fit], Posterior], fits: Sequence[Fit], processes: int | None) -> list[Fit]:
    """Better fits of the same models; only posteriors go between processes, a user's effects cannot."""
    return [Fit(fit.model, p) for fit, p in zip(fits, spread(job, fits, processes), strict=True)]


def _promising(
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
    chosen += [score for score in best[count:_FURTHER] if score.gain > _PROMISING]
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


def _with_promising(
    observations: Observations,
    wide: Fit,
    ranking: Ranking,
    hypotheses: Sequence[Hypothesis],
    models: Mapping[str, Model],
    processes: int | None,
) -> Ranking:
    """The ranking with what promises and gains something beside its learned scatters, and was behind at wide ones.

    `wide` is the base model at those, beside which all but the finalists are.
    """
    base, final = ranking.base, [r for r in ranking.ranked if r.final]
    if not unbent(observations, base):
        return ranking
    taken = {r.hypothesis.label for r in final}
    others = [h for h in hypotheses if h.label not in taken]
    found = _promising(observations, base, others, models, 0, processes)
    more = [(h, fit) for h, fit in found if fit.log_evidence > base.log_evidence + _PROMISING]
    if not more:
        return ranking
    order = [(r.hypothesis, r.fit) for r in ranking.ranked]
    return _finals(observations, wide, order, more, processes, (base,), past_barriers=False)


def _narrowed(observations: Observations, settled: Fit) -> Fit | None:
    """The base model at a scatter of shapes half the way to its least; None where it is near it.

    What is missing may have been learned as scatter of shapes: a spring of 171 kN/m between the first and the fifth of
    six masses gained nothing beside shapes that scatter by 0.006, and 26 once that was learned anew with it.
    """
    shapes, scatters = observations.scatters.get(SHAPE), settled.posterior.scatters
    if shapes is None or scatters[SHAPE] <= _TAKEN_UP * shapes.least * shapes.default:
        return None
    narrow = float(np.sqrt(shapes.least * shapes.default * scatters[SHAPE]))
    return refined(observations, settled.model, settled.posterior.x, {**scatters, SHAPE: narrow})


def _finals(
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
    best, rest = order[:FINALISTS], order[FINALISTS:]
    near = unbeaten(best, lambda pair: pair[1].log_evidence)
    far = best[len(near) :]
    finalists = [*near, *promising]
    job = partial(_learned, observations, past_barriers)
    fits = [fit for _, fit in finalists]
    if past_barriers:
        base_now, *first = _spread_fits(job, [base, *fits], processes)
        known = [base_now, *known]
    else:
        first = _spread_fits(job, fits, processes)
    first = [max(known, key=lambda f: f.log_evidence), *first]
    beaten = _spread_fits(partial(_learned, observations, False), [fit for _, fit in far], processes)
    leaders = sorted(first[1:], key=lambda f: -f.log_evidence)
    job = partial(_crossed, observations, (first[0], *leaders[:2]))
    final_base, *again = _spread_fits(job, first, processes)
    found = [
        Ranked(hypothesis, fit, fit.log_evidence - final_base.log_evidence, True)
        for (hypothesis, _), fit in zip((*finalists, *far), (*again, *beaten), strict=True)
    ]
    best_of_each = {r.hypothesis.label: r for r in sorted(found, key=lambda r: r.gain)}
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


def _learned(observations: Observations, past_barriers: bool, fit: Fit) -> Posterior:
    return learned(observations, fit, past_barriers).posterior


def _crossed(observations: Observations, sources: Sequence[Fit], fit: Fit) -> Posterior:
    """The fit begun again at what others know, scatters included, and learned from there where that is better."""
    best = fit
    for source in sources:
        if source is fit:
            continue
        scatters = source.posterior.scatters
        start = refined(
            observations, fit.model, _on(observations, fit.model, source, fit), scatters, steps=10
        )
        here = refined(observations, fit.model, best.posterior.x, scatters, steps=4)
        if start.log_evidence > here.log_evidence + _BETTER:
            again = learned(observations, start, past_barriers=False)
            best = max(best, again, key=lambda f: f.log_evidence)
    return best.posterior
