"""Every hypothesis fitted on top of the current model, and ranked by its evidence.

Most wrong names come from local optima: if the base fit is stuck in one, any hypothesis that escapes it appears to gain
evidence. So fits are annealed, and the base and every hypothesis are begun again from the best values known of all
else.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

from ema_pipeline.diagnose.finals import (
    PROMISING,
    finals_of,
    known_from,
    leading,
    narrowed,
    promising_fits,
    spread_fits,
    with_promising,
)
from ema_pipeline.diagnose.first_fits import (
    Tried,
    annealed_fit,
    continued_fit,
    first_fit,
    short_fits,
    tried_sizes,
)
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ranked import BEATEN, Ranking, unbeaten
from ema_pipeline.diagnose.score import UNSEEN, Score, scores
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, freed, learned, met, refined, unbent, within_scatter
from ema_pipeline.processes import aside, spread

Progress = Callable[[float, str], None]

_SCREENED = 14
"""Hypotheses of one kind, generic or the rig's own, best first by their score, that are fitted in full."""
_SCREENED_LAWS = 24
"""The same of nonlinear laws in forces in time, where the base model fails: their score is that of a small size on top
of a model that is bent to the data, and put a cubic spring of a chain of three, which explained all, fifteenth. Such a
chain has eighteen of one size."""
_ANNEALED = 16
"""Hypotheses, best first by a short fit, that are fitted in full where the base model fails, or is bent to the data;
beside them as many of which some size gives modes without a partner one. What led in the end was among the first eight
of some sixty, or of these."""
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
CONTENDERS = 12
"""Hypotheses that are worth a second refinement."""
_EXPLAINED = 1.3
"""Error up to which the base model is near enough for hypotheses to begin at its fit."""


def rank(
    observations: Observations,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    processes: int | None = 1,
    progress: Progress = lambda share, text: None,
    further: int = 0,
    unpaired: float = 0.0,
    before: Mapping[str, Posterior] | None = None,
    reached: Sequence[Fit] = (),
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
        What modes without a partner cost whatever was added in an earlier ranking: no reason to search further where
        all of them are doubtful.
    before : dict of str to Posterior, optional
        Fits of hypotheses to the same data with fewer unknowns, from which theirs are begun.
    reached : sequence of Fit
        Of the current model, with scatters learned when its last effect was added: from wide ones no path need lead
        there.
    """
    models = {h.label: base.model.plus(h.placed, h.scales) for h in hypotheses}
    residuals, fails = base.posterior.residuals, base.posterior.error > _EXPLAINED
    # a model that explains all that was surely measured needs no search for the sake of other modes
    explains = not fails and not residuals.unexplained
    # what no effect alone gave a partner another may give one beside it
    alone = not explains and residuals.penalty > (0.0 if residuals.unexplained else unpaired)
    tried = tried_sizes(observations, base, models, hypotheses, processes) if alone else {}
    lost = bool(tried) or (alone and residuals.unexplained > 0)
    stuck = lost or fails

    def settle() -> Posterior | None:
        bases = [] if stuck else [learned(observations, base), *reached]
        return max((fit.posterior for fit in bases), key=lambda p: p.log_evidence, default=None)

    with aside(settle, processes) as settled_aside:
        promise = {s.hypothesis.label: s for s in scores(observations, base, hypotheses, models, processes)}
        posterior = settled_aside()
    settled = None if posterior is None else Fit(base.model, posterior)
    unseen = {label for label, score in promise.items() if score.std >= UNSEEN} - set(tried)
    hypotheses = [h for h in hypotheses if h.label not in unseen]
    near = settled is not None and unbent(observations, settled)
    pairing = _best_tried(tried, _PAIRING)
    among = _screened(hypotheses, promise, near)
    earlier = before or {}
    chosen = [h for h in hypotheses if h in among or h.label in pairing or h.label in earlier]

    def job(hypothesis: Hypothesis) -> Posterior:
        if stuck:
            anew = partial(annealed_fit, observations, base, models, promise, tried, hypothesis)
        else:
            anew = partial(first_fit, observations, base, models, promise, hypothesis, near)
        if hypothesis.label not in earlier:
            return anew()
        return continued_fit(observations, base, models[hypothesis.label], earlier[hypothesis.label], anew)

    short = partial(short_fits, observations, base, models, promise)
    known: dict[str, Posterior] = {}
    if not near:
        # A few steps do not lead a mode of the model to a measured one that has no partner yet.
        leads = _best_tried({label: one for label, one in tried.items() if one.gain > PROMISING}, _ANNEALED)
        behind = short(chosen, processes)[_ANNEALED:]
        known |= {h.label: fitted for h, fitted in behind if h.label not in leads and h.label not in earlier}
    decided = False
    left = [h for h in chosen if h.label not in known]
    for batch in _batches(left, promise if lost else {}, pairing):
        if decided:
            known |= {h.label: fitted for h, fitted in short(batch, processes)}
        asked = [h for h in batch if h.label not in known]
        for hypothesis, fitted in zip(asked, spread(job, asked, processes), strict=True):
            known[hypothesis.label] = fitted
            progress(0.6 * len(known) / len(chosen), hypothesis.label)
        decided = lost and any(_decides(p, base) for p in known.values())
    found = {h.label: (h, Fit(models[h.label], known[h.label])) for h in chosen}
    if not near and not decided:
        again = _leading(found, _FIRST) if stuck else _contenders(found, _FIRST)
        base, found = _begun_again(observations, base, found, processes, again, steps=5)
    found = _bettered(found, _contenders(found), lambda fit: freed(observations, fit).posterior, processes)
    base, found = _begun_again(observations, base, found, processes, _contenders(found), steps=12)
    progress(0.8, "scatter of parts and channels")
    order = sorted(found.values(), key=lambda pair: -pair[1].log_evidence)
    taken = {best.label for best, _ in leading(order, base)}
    others = [h for h in hypotheses if h.label not in taken]
    if settled is None:
        ranking = finals_of(observations, base, order, (), processes, reached, past_barriers=True)
        return with_promising(observations, base, ranking, hypotheses, models, processes)
    straight = within_scatter(observations, settled)  # itself, but for one that is bent
    promising = promising_fits(observations, straight, others, models, further if near else 0, processes)
    bases = [settled] if near else [*reached]
    narrow = narrowed(observations, settled)
    if narrow is not None:
        promising += promising_fits(observations, narrow, hypotheses, models, 0, processes)
        bases.append(learned(observations, narrow, past_barriers=False))
    return finals_of(observations, base, order, promising, processes, bases, past_barriers=not near)


def _screened(hypotheses: Sequence[Hypothesis], promise: Mapping[str, Score], near: bool) -> list[Hypothesis]:
    """The rig's own hypotheses, and the generic ones that promise most.

    Near the base model the score tells of the rig's own as well: those that promise nothing are left out, too, with
    those that have a direction. Other effects of several sizes (hysteresis) show their kind at a finite size only, of
    which a score knows nothing.
    """
    out: set[str] = set()
    scored = [h for h in hypotheses if h.label in promise]
    scored = [h for h in scored if len(h.placed.effect.parameters) == 1 or (near and h.has_direction)]
    if not near:
        laws = [h.label for h in scored if h.begun and not h.placed.effect.linear]
        out |= set(sorted(laws, key=lambda label: -promise[label].gain)[_SCREENED_LAWS:])
        scored = [h for h in scored if h.label not in laws]
    for generic in (True, False) if near else (True,):
        order = sorted((h for h in scored if h.generic is generic), key=lambda h: -promise[h.label].gain)
        out |= {h.label for h in order[_SCREENED:]}
        if near:
            out |= {h.label for h in order[_UNPROMISING:] if promise[h.label].gain < PROMISING}
    return [h for h in hypotheses if h.label not in out]


def _best_tried(tried: Mapping[str, Tried], most: int) -> set[str]:
    """Hypotheses of which some size gives modes without a partner one: the best of them, and those that pair most."""
    pairing = [label for label, one in tried.items() if one.pairs > 0]
    most_pairing = sorted(pairing, key=lambda label: (-tried[label].pairs, -tried[label].gain))[:most]
    return {*sorted(tried, key=lambda label: -tried[label].gain)[:most], *most_pairing}


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
    return found.error < _ALL and found.log_evidence > base.log_evidence + BEATEN


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
    again = refined(observations, base.model, known_from(observations, base.model, top, base), steps=20)
    base = max(base, again, key=lambda fit: fit.log_evidence)
    job = partial(_better, observations, (base, top), steps)
    return base, _bettered(found, contenders, job, processes)


def _contenders(found: Found, most: int = CONTENDERS) -> list[str]:
    """The best hypotheses, and none that is beaten."""
    return unbeaten(_leading(found, most), lambda label: found[label][1].log_evidence)


def _leading(found: Found, most: int) -> list[str]:
    """The best hypotheses."""
    return sorted(found, key=lambda label: -found[label][1].log_evidence)[:most]


def _bettered(
    found: Found, contenders: Collection[str], job: Callable[[Fit], Posterior], processes: int | None
) -> Found:
    """The hypotheses, some of them with what `job` makes of their fits."""
    items = [found[label] for label in contenders]
    better = spread_fits(job, [fit for _, fit in items], processes)
    return found | {h.label: (h, fit) for (h, _), fit in zip(items, better, strict=True)}


def _better(observations: Observations, sources: Sequence[Fit], steps: int, fit: Fit) -> Posterior:
    best = fit
    for source in sources:
        x = known_from(observations, fit.model, source, fit)
        if met(best.posterior, x):
            continue
        again = refined(observations, fit.model, x, steps=steps)
        best = max(best, again, key=lambda f: f.log_evidence)
    return best.posterior
