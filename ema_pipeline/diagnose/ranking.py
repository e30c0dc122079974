"""Fits of all hypotheses of one base model, and their probabilities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.diagnose.fitting import Case, Fitted, fit_hypothesis, follow, ground, holds, near, refit
from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, extras, prior_probabilities
from ema_pipeline.diagnose.pool import spread
from ema_pipeline.diagnose.progress import Progress
from ema_pipeline.diagnose.types import OUT_OF_TOLERANCE
from ema_pipeline.fit.settings import FitSettings

_NULL_FROM = 4
_NULL_ROUNDS = 3
_RACING = 8
_OUT_OF_RACE = 60.0
_NOTHING_GAINED = 4.0


@dataclass(frozen=True)
class Ranking:
    """A base model and everything that was tried on top of it.

    Attributes
    ----------
    base : Fitted
    fitted : tuple of Fitted
        In the order of the hypotheses.
    probabilities : dict of str to float
        By label, ``"nothing"`` for the base model; adds up to 1.
    """

    base: Fitted
    fitted: tuple[Fitted, ...]
    probabilities: dict[str, float]

    def ordered(self) -> list[Fitted]:
        """The most probable first."""
        return sorted(self.fitted, key=lambda f: -self.probabilities[f.hypothesis.label])

    def worthwhile(self) -> list[Fitted]:
        """The base model, and what is better supported than it before prior odds count."""
        return [self.base, *(f for f in self.fitted if f.evidence < self.base.evidence)]

    def gain(self, f: Fitted) -> float:
        """Fall of -2 log posterior, the mixing of near modes integrated out."""
        return self.base.objective + self.base.volume - f.objective - f.volume

    def log_evidence(self, f: Fitted) -> float:
        """Natural logarithm of the Bayes factor against the base model."""
        return -0.5 * (f.evidence - self.base.evidence)


def rank(
    case: Case, base: Fitted, hypotheses: Sequence[Hypothesis], fit: FitSettings, tell: Progress
) -> Ranking:
    """Fit all hypotheses on top of a base model, and the base model from all of their optima.

    Parameters
    ----------
    case : Case
    base : Fitted
    hypotheses : sequence of Hypothesis
    fit : FitSettings
    tell : callable
    """
    below = ground(case, base, fit)

    def one(h: Hypothesis) -> Fitted:
        return fit_hypothesis(case, h, fit, below)

    return _ranked(case, base, hypotheses, one, fit, tell)


def sharpen(case: Case, ranking: Ranking, base: Fitted, fit: FitSettings, tell: Progress) -> Ranking:
    """The same ranking at another noise level, every fit started from its own optimum.

    Hypotheses that are out of the race are not fitted again; they keep their distance from the base model.
    """
    best = min(f.evidence for f in (ranking.base, *ranking.fitted))
    ordered = ranking.ordered()
    racing = {f.hypothesis.label for f in ordered[:_RACING]}
    racing |= {f.hypothesis.label for f in ordered if f.evidence < best + _OUT_OF_RACE}
    found = {f.hypothesis.label: f for f in ranking.fitted}

    def one(h: Hypothesis) -> Fitted:
        return follow(case, found[h.label], fit)

    sharp = _ranked(
        case, base, [f.hypothesis for f in ranking.fitted if f.hypothesis.label in racing], one, fit, tell
    )
    by_label = {f.hypothesis.label: f for f in sharp.fitted}
    fitted = [
        by_label.get(f.hypothesis.label) or _moved_along(f, ranking.base, sharp.base) for f in ranking.fitted
    ]
    return Ranking(sharp.base, tuple(fitted), probabilities(case, sharp.base, fitted))


def _moved_along(f: Fitted, old: Fitted, new: Fitted) -> Fitted:
    return replace(
        f,
        objective=f.objective - old.objective + new.objective,
        evidence=f.evidence - old.evidence + new.evidence,
        costs=new.costs,
        inlier=new.inlier,
        prior_cost=new.prior_cost,
        volume=f.volume - old.volume + new.volume,
        alone=new.alone,
    )


def _ranked(
    case: Case,
    base: Fitted,
    hypotheses: Sequence[Hypothesis],
    one: Callable[[Hypothesis], Fitted],
    fit: FitSettings,
    tell: Progress,
) -> Ranking:
    fitted = []
    for f in spread(one, hypotheses, case.settings.processes):
        fitted.append(f)
        tell(len(fitted) / len(hypotheses), f.hypothesis.label)
    base = settle_base(case, base, fitted, fit)
    fitted = [_never_worse(f, base) for f in fitted]
    return Ranking(base, tuple(fitted), probabilities(case, base, fitted))


def settle_base(case: Case, base: Fitted, fitted: Sequence[Fitted], fit: FitSettings) -> Fitted:
    """The base model refitted from the parameters of the best hypotheses, until it gets no better.

    Otherwise the gain of a hypothesis may only be that its start led to a better optimum.
    """
    for _ in range(_NULL_ROUNDS):
        best = base
        for f in sorted(fitted, key=lambda f: f.objective)[:_NULL_FROM]:
            other = refit(case, base.hypothesis, fit, f.values)
            if other.objective < best.objective - 1e-6:
                best = other
        if best.objective > base.objective - 0.01:
            return best
        base = best
    return base


def _never_worse(f: Fitted, base: Fitted) -> Fitted:
    """A richer model holds the poorer one: where its fit ended higher, the poorer one's costs stand.

    Evidence cannot grow by more than the likelihood does.
    """
    if f.objective <= base.objective:
        return replace(f, evidence=max(f.evidence, base.evidence + f.objective - base.objective))
    return replace(
        f,
        objective=base.objective,
        evidence=max(f.evidence - (f.objective - base.objective), base.evidence + _NOTHING_GAINED),
        costs=base.costs,
        inlier=base.inlier,
        prior_cost=base.prior_cost,
        volume=base.volume,
        alone=base.alone,
    )


def probabilities(case: Case, base: Fitted, fitted: Sequence[Fitted]) -> dict[str, float]:
    """Posterior probabilities of the hypotheses and of ``"nothing"`` (more).

    An effect so slight that parts made to one drawing differ by as much is no missing physics: on top of a model that
    holds, or whose unexplained modes it does not explain either, its probability goes to ``"nothing"``.
    """
    settings = case.settings
    prior = prior_probabilities([f.hypothesis for f in fitted], settings.null_prior, settings.parameter_prior)
    evidence = {NOTHING: base.evidence} | {f.hypothesis.label: f.evidence for f in fitted}
    logs = {label: np.log(max(prior[label], 1e-300)) - 0.5 * e for label, e in evidence.items()}
    top = max(logs.values())
    weights = {label: float(np.exp(v - top)) for label, v in logs.items()}
    total = sum(weights.values())
    shares = {label: w / total for label, w in weights.items()}
    for f in fitted if near(base) else ():
        idle = int(np.sum(f.explained)) <= int(np.sum(base.explained))
        if (idle or holds(base)) and slight(case, f):
            shares[NOTHING] += shares[f.hypothesis.label]
            shares[f.hypothesis.label] = 0.0
    return shares


def slight(case: Case, f: Fitted) -> bool:
    """True for an effect added last all of whose sizes are below what is worth a claim."""
    label = f.hypothesis.labels[-1]
    if f.hypothesis.family == OUT_OF_TOLERANCE:
        return False
    sizes = [
        e for e in extras(case.rig, Hypothesis((label,)), case.library) if e.slight > 0 and e.name in f.values
    ]
    return bool(sizes) and all(abs(f.values[e.name] - e.null) < e.slight for e in sizes)
