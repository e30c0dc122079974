"""Backward steps of the selection: what was added early may be needless, or something else, once the rest is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from ema_pipeline.diagnose.claims import Judged, judge
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.diagnose.rounds import Round
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import QUICK, Fit, Model, annealed, best_refined, learned, transferred
from ema_pipeline.processes import spread

_WORTH = 2
"""Changes that are worth a process each: their scatters are learned, which takes as long as dozens of steps."""


def reconsidered(
    observations: Observations,
    start: Fit,
    claimed: Sequence[Judged],
    rounds: dict[str, Round],
    settings: DiagnoseSettings,
) -> list[Judged]:
    """Claims without those that are needless by now or cannot be told from a later one, and with those replaced that a
    rival explains better.

    Parameters
    ----------
    observations : Observations
    start : Fit
        The model before any claim.
    claimed : sequence of Judged
        In the order in which they were added.
    rounds : dict of str to Round
        By the label of a claim, with its rivals. A replacement inherits them.
    settings : DiagnoseSettings

    Returns
    -------
    list of Judged
        The same where nothing changes; else judged anew, one on top of the other.
    """
    now = _told_apart(observations, [j.hypothesis for j in claimed])
    changed = len(now) < len(claimed)
    last = claimed[-1].ranked.fit
    fit = _fitted(observations, start.model, now, last) if changed else learned(observations, last)
    while len(now) > 1:
        better = _best_change(observations, start.model, now, fit, rounds, settings)
        if better is None:
            break
        now, fit, changed = *better, True
    return _judged_anew(observations, start, now, fit, settings) if changed else list(claimed)


def alike_beside(
    observations: Observations,
    known: Model,
    claimed: Sequence[Judged],
    rounds: dict[str, Round],
    final: Fit,
    settings: DiagnoseSettings,
) -> tuple[tuple[Judged, ...], ...]:
    """Each claim and what explains the data as well in its place, all other claims known.

    What came near an early claim may be far behind once the later ones are known, or be one of them, and what was far
    behind may come near: it is judged anew beside them.
    """
    effects = [j.hypothesis for j in claimed]
    labels = [h.label for h in effects]

    def beside_others(i: int, rivals: Sequence[Judged]) -> Iterator[Judged]:
        def fitted(rival: Judged) -> Posterior:
            return _fitted(observations, known, instead(rival.hypothesis), final, rival).posterior

        def instead(*one: Hypothesis) -> list[Hypothesis]:
            return [*effects[:i], *one, *effects[i + 1 :]]

        base = _fitted(observations, known, instead(), final)
        for rival, p in zip(rivals, spread(fitted, rivals, settings.processes, _WORTH), strict=True):
            if final.log_evidence - p.log_evidence < settings.alike:
                fit = Fit(_with(known, instead(rival.hypothesis)), p)
                ranked = replace(rival.ranked, fit=fit, gain=p.log_evidence - base.log_evidence)
                yield judge(observations, Ranking(base, (ranked,)), ranked, settings)

    told = []
    for i, one in enumerate(claimed):
        of = rounds[labels[i]]
        last = one is claimed[-1] and any(one is j for j in of.alike(settings))
        rivals = [j for j in (of.alike(settings) if last else of.judged) if j.hypothesis.label not in labels]
        told.append((one, *(rivals if last or not rivals else beside_others(i, rivals))))
    return tuple(told)


def cannot_be_told(observations: Observations, linear: Hypothesis, other: Hypothesis) -> bool:
    """True where a linear effect does what equivalent linearisation leaves of a nonlinear one at the same place.

    Teeth that part are softer on the average than what is calculated of them, just as worn ones are.
    """
    a, b = linear.placed, other.placed
    return observations.linearised and a.effect.linear and not b.effect.linear and a.place == b.place


def _told_apart(observations: Observations, effects: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Without linear effects beside a nonlinear one from which they cannot be told. Masses can: a law is a force.

    The evidence does not tell: teeth that part gained 49 beside a loss of 68 % of their mesh's stiffness, which was
    none, and that 107 beside the teeth.
    """

    def stays(one: Hypothesis) -> bool:
        mass = any(p.unit == "kg" for p in one.placed.effect.parameters)
        return mass or not any(cannot_be_told(observations, one, other) for other in effects)

    return [h for h in effects if stays(h)]


@dataclass(frozen=True)
class _Plan:
    """A change: the effects after it, the one that goes, and what takes its place, if anything does."""

    effects: Sequence[Hypothesis]
    before: Hypothesis
    rival: Judged | None = None


def _best_change(
    observations: Observations,
    known: Model,
    now: Sequence[Hypothesis],
    fit: Fit,
    rounds: dict[str, Round],
    settings: DiagnoseSettings,
) -> tuple[list[Hypothesis], Fit] | None:
    """The change that raises the evidence most, a needless effect counting as much as a claim needs."""
    labels = {h.label for h in now}
    plans: list[_Plan] = []
    for i, one in enumerate(now[:-1]):  # the last was judged with all others known
        plans.append(_Plan([h for h in now if h is not one], one))
        for rival in rounds[one.label].judged:
            if rival.hypothesis.label not in labels:
                plans.append(_Plan([*now[:i], rival.hypothesis, *now[i + 1 :]], one, rival))

    def fitted(plan: _Plan) -> Posterior:
        return _fitted(observations, known, plan.effects, fit, plan.rival).posterior

    found = list(spread(fitted, plans, settings.processes, _WORTH))
    scores = [
        p.log_evidence + (settings.claim if plan.rival is None else -settings.alike)
        for plan, p in zip(plans, found, strict=True)
    ]
    best = max(range(len(plans)), key=scores.__getitem__)
    if scores[best] <= fit.log_evidence:
        return None
    plan = plans[best]
    after = plan.before if plan.rival is None else plan.rival.hypothesis
    rounds.setdefault(after.label, rounds[plan.before.label])
    return list(plan.effects), Fit(_with(known, plan.effects), found[best])


def _with(known: Model, effects: Sequence[Hypothesis]) -> Model:
    model = known
    for h in effects:
        model = model.plus(h.placed, h.scales)
    return model


def _fitted(
    observations: Observations,
    known: Model,
    effects: Sequence[Hypothesis],
    near: Fit,
    rival: Judged | None = None,
) -> Fit:
    """A model begun at a fit nearby, a rival at its own sizes and annealed; scatters learned.

    With a rival, the sizes of the others may be far from those nearby: twice the mass, beside a spring at its body.
    """
    model = _with(known, effects)
    problem = model.problem(observations)
    x = transferred(near.posterior, problem.unknowns)
    starts = [x]
    if rival is not None:
        sizes = rival.ranked.fit.posterior
        for p in rival.hypothesis.placed.effect.parameters:
            name = rival.hypothesis.placed.parameter_name(p.name)
            x[problem.unknowns.index[name]] = sizes.value(name)
        if not observations.slow:
            starts.append(annealed(observations, model, [x], QUICK).posterior.x)
    return learned(observations, best_refined(observations, model, starts, near.posterior.scatters))


def _judged_anew(
    observations: Observations,
    start: Fit,
    effects: Sequence[Hypothesis],
    fit: Fit,
    settings: DiagnoseSettings,
) -> list[Judged]:
    """Every effect judged on top of those before it."""
    base, found = learned(observations, start), []
    for k in range(1, len(effects) + 1):
        last = k == len(effects)
        here = fit if last else _fitted(observations, start.model, effects[:k], fit)
        ranked = Ranked(effects[k - 1], here, here.log_evidence - base.log_evidence, True)
        found.append(judge(observations, Ranking(base, (ranked,)), ranked, settings))
        base = here
    return found
