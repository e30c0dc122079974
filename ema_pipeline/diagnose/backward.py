"""Backward steps of the selection: what was added early may be needless, or something else, once the rest is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ema_pipeline.diagnose.claims import Judged, judge
from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.diagnose.ranked import Ranked, Ranking
from ema_pipeline.diagnose.rounds import Round
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.inference import Posterior
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, Model, learned, refined, transferred
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

    What came near an early claim may be far behind once the later ones are known, or be one of them.
    """
    effects = [j.hypothesis for j in claimed]
    labels = [h.label for h in effects]
    told = []
    for i, one in enumerate(claimed):
        near = rounds[labels[i]].alike(settings)
        rivals = [j for j in near if j.hypothesis.label not in labels]
        if rivals and (one is not claimed[-1] or not any(one is j for j in near)):

            def evidence(rival: Judged, i: int = i) -> float:
                instead = [*effects[:i], rival.hypothesis, *effects[i + 1 :]]
                return _fitted(observations, known, instead, final, rival).log_evidence

            reached = spread(evidence, rivals, settings.processes, _WORTH)
            near_final = (final.log_evidence - e < settings.alike for e in reached)
            rivals = [j for j, stays in zip(rivals, near_final, strict=True) if stays]
        told.append((one, *rivals))
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
    """A model begun at a fit nearby, a rival at its own sizes; scatters learned."""
    model = _with(known, effects)
    problem = model.problem(observations)
    x = transferred(near.posterior, problem.unknowns)
    if rival is not None:
        sizes = rival.ranked.fit.posterior
        for p in rival.hypothesis.placed.effect.parameters:
            name = rival.hypothesis.placed.parameter_name(p.name)
            x[problem.unknowns.index[name]] = sizes.value(name)
    return learned(observations, refined(observations, model, x, near.posterior.scatters, steps=20))


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
