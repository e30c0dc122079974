"""Fits of all hypotheses: sizes over decades compete first, the best are followed to the end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import (
    NOTHING,
    Hypothesis,
    extras,
    prior_probabilities,
    single_hypotheses,
    starting_points,
)
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, judged, level_hypotheses, size_grid, sized
from ema_pipeline.diagnose.levels.problem import (
    NoiseFloor,
    TimeFit,
    Whitening,
    fit,
    linearised,
    objectives,
    weighted,
)
from ema_pipeline.diagnose.pool import spread
from ema_pipeline.diagnose.progress import Progress
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.errors import EmaError

_FOLLOWED = 2
_HELPS = 0.5
_APART = 0.3
_NEAR = 0.005
_ALIKE = 0.02
_AGAIN = 6
_HOPELESS = 100.0
"""A fit whose -2 log evidence is worse than the best one's by this is not followed as the floor of the noise moves."""
_GROWING = (0.05, 0.15)
"""Shares of the windows: far from the right frequencies, or where parts strike, long ones have no slope to follow."""
_STEPS = 8
_NEIGHBOURS = (1.0, 0.9, 0.93, 0.96, 0.98, 1.02, 1.04, 1.07, 1.1)
_DENSE, _SPARSE = 5, 2
"""Sizes per decade that compete in short windows after softer hits, and in longer ones after all."""
_BETWEEN = 0.5
"""Steps of that grid to either side of the best sizes, which compete as well: where parts strike, optima are narrow."""
_CLOSE = 1.5
"""Error, in standard uncertainties, of a base model to which a further effect adds little: long windows lead there."""
_POLISHED = 2
_MOST_STEPS = 25


class Growing:
    """The windows over which fits grow, with their weights, and what the parameters of a base model do there.

    Parameters
    ----------
    case : LevelCase
    floor : NoiseFloor
    base : Simulated, optional
        Its slopes are tried first by the fits on top of it, which all begin near to it.
    """

    def __init__(self, case: LevelCase, floor: NoiseFloor, base: Simulated | None = None) -> None:
        self.case, self.floor = case, floor
        self.first = _Part(case.beginning(_GROWING[0]), floor, base)
        softer, longer = case.softer().beginning(_GROWING[-1]), case.beginning(_GROWING[-1])
        self.parts = (_Part(softer, floor, base), self.first, _Part(longer, floor, base))
        self.whole = _Part(case.coarse(), floor, base)

    @cached_property
    def rough(self) -> _Part:
        """Enough to tell orders of magnitude."""
        return _Part(self.case.rough(), self.floor)

    @cached_property
    def forgiving(self) -> _Part:
        """The first part of the windows after softer hits, for a base model that is far off."""
        most = NoiseFloor(self.case.settings.levels.noise_most, self.floor.common)
        return _Part(self.parts[0].case, most)

    def follow(
        self,
        hypothesis: Hypothesis,
        begun: Sequence[tuple[Mapping[str, float], Mapping[str, float]]],
    ) -> Simulated:
        """The best of fits that begin on the first part of the windows after softer hits and follow it as they grow.

        Fits that have met by then are followed to the end once.

        Parameters
        ----------
        hypothesis : Hypothesis
        begun : sequence of (mapping of str to float, mapping of str to float)
            Typical values of the effects' parameters, and all values where a fit begins.
        """
        grown: list[tuple[Mapping[str, float], TimeFit]] = []
        for sizes, values in begun:
            now = values
            for part in self.parts:
                found = _stage(part, hypothesis, sizes, now)
                now = found.values
            if not any(_met(found, other, _first_size(hypothesis, sizes)) for _, other in grown):
                grown.append((sizes, found))
        ends = [
            judged(
                self.whole.case.problem(hypothesis, sizes),
                hypothesis,
                sizes,
                _stage(self.whole, hypothesis, sizes, found.values),
            )
            for sizes, found in grown
        ]
        return min(ends, key=lambda m: m.fit.objective)


class _Part:
    """Some of the windows."""

    def __init__(self, case: LevelCase, floor: NoiseFloor, base: Simulated | None = None) -> None:
        self.case = case
        self.weights = case.weights(floor)
        self.slopes = slopes_of(case, self.weights, base) if base is not None else {}


def slopes_of(
    case: LevelCase, weights: Sequence[Whitening], base: Simulated
) -> dict[str, NDArray[np.float64]]:
    """Slopes of the weighted differences at a model, by parameter; none where its motion has no solution."""
    problem = case.problem(base.hypothesis, base.sizes)
    try:
        _, jacobian = linearised(problem, weights, problem.space.point(base.values))
    except EmaError:
        return {}
    return dict(zip(problem.space.names, jacobian, strict=True))


def fit_base(
    case: LevelCase, hypothesis: Hypothesis, floor: NoiseFloor, sizes: Mapping[str, float]
) -> Simulated:
    """The best fit of a model from all of the case's starts."""
    begun = [(sizes, {**s, **sizes}) for s in _distinct_starts(case.starts)]
    best = again(case.coarse(), Growing(case, floor).follow(hypothesis, begun), floor, _MOST_STEPS)
    return again(case, best, floor, _MOST_STEPS)


def _first_size(hypothesis: Hypothesis, sizes: Mapping[str, float]) -> list[str]:
    """The first of the sizes of the effect added last, if any."""
    return [n for n in sizes if n.rpartition(".")[0] in hypothesis.labels[-1:]][:1]


def _met(one: TimeFit, other: TimeFit, own: Sequence[str]) -> bool:
    """True for fits of the same windows that ended at one place."""
    apart = abs(one.objective - other.objective)
    near = all(abs(one.values[n] - other.values[n]) <= _ALIKE * abs(other.values[n]) for n in own)
    return near and apart <= _ALIKE * (1 + min(one.objective, other.objective))


def _stage(
    part: _Part, hypothesis: Hypothesis, sizes: Mapping[str, float], values: Mapping[str, float]
) -> TimeFit:
    """A fit from the best of neighbouring sizes: where parts strike there are many optima side by side."""
    problem = part.case.problem(hypothesis, sizes)
    x = np.array([problem.space.point(values)])
    for name in _first_size(hypothesis, sizes):
        x = np.array([problem.space.point({**values, name: values[name] * k}) for k in _NEIGHBOURS])
        x = x[[np.argmin(objectives(problem, part.weights, x))]]
    return fit(problem, part.weights, x[0], _STEPS, part.slopes)


def again(
    case: LevelCase,
    model: Simulated,
    floor: NoiseFloor,
    steps: int = _AGAIN,
    known: Mapping[str, NDArray[np.float64]] | None = None,
) -> Simulated:
    """The same model at another floor of the noise, from its own optimum."""
    sizes = {n: model.values.get(n, v) or v for n, v in model.sizes.items()}
    problem = case.problem(model.hypothesis, sizes)
    found = fit(problem, case.weights(floor), problem.space.point(model.values), steps, known)
    return judged(problem, model.hypothesis, sizes, found)


def fit_effect(windows: Growing, hypothesis: Hypothesis, base: Simulated) -> Simulated:
    """Fit of a hypothesis on top of a base model, from sizes over many decades.

    Parameters
    ----------
    windows : Growing
    hypothesis : Hypothesis
        The base model's and one more effect.
    base : Simulated
    """
    case = windows.case
    starts = _starts(case, base)
    chosen = _competing(windows.rough, hypothesis, base, starts, _SPARSE)
    if base.fit.objective > _CLOSE**2 * case.data or not base.sizes:
        chosen += _competing(windows.forgiving, hypothesis, base, starts, _DENSE)
    begun = []
    for t in chosen:
        own = sized(case, hypothesis, t.sizes)
        begun.append(({**base.sizes, **own}, {**base.values, **starts[t.start], **own}))
    if not begun:
        raise AssertionError(f"no size of {hypothesis.label} can be simulated")
    return windows.follow(hypothesis, begun)


def _competing(
    part: _Part,
    hypothesis: Hypothesis,
    base: Simulated,
    starts: Sequence[Mapping[str, float]],
    per_decade: int,
) -> list[_Tried]:
    """Sizes of the effect added last that are worth following, from all starts of the other parameters."""
    case = part.case
    first, *others = case.parameters_of(hypothesis.labels[-1])
    points = list(product(size_grid(first, per_decade), *((p.start, 0.1 * p.start) for p in others)))
    problem, weights = case.problem(hypothesis), part.weights

    def tries(of: Sequence[tuple[int, tuple[float, ...]]]) -> list[_Tried]:
        named = [{**base.values, **starts[k], **sized(case, hypothesis, v)} for k, v in of]
        x = np.array([problem.space.point(values) for values in named])
        return [_Tried(float(o), k, v) for o, (k, v) in zip(objectives(problem, weights, x), of, strict=True)]

    tried = tries(list(product(range(len(starts)), points)))
    best = [t for t in _worth_following(tried, first.null) if t.helps]
    beside = 10.0 ** (_BETWEEN / per_decade * np.array([-1, 1]))
    near = [(t.start, (t.sizes[0] * float(b), *t.sizes[1:])) for t in best for b in beside]
    return _worth_following(tried + tries(near), first.null) if near else _worth_following(tried, first.null)


def fit_linear(windows: Growing, hypothesis: Hypothesis, base: Simulated) -> Simulated | None:
    """Fit with one more effect that does not depend on the level, or None for one that has no time response."""
    case, brief = windows.case, windows.first
    problem = brief.case.problem(hypothesis, base.sizes)
    added = starting_points(extras(case.rig, hypothesis, case.library))
    starts = [{**base.values, **s, **p} for s in _starts(case, base) for p in added]
    tried = objectives(problem, brief.weights, np.array([problem.space.point(s) for s in starts]))
    if not np.any(np.isfinite(tried)):
        return None
    order = [int(k) for k in np.argsort(tried)[:_FOLLOWED] if np.isfinite(tried[k])]
    return windows.follow(hypothesis, [(base.sizes, starts[k]) for k in order])


class _Tried(NamedTuple):
    """A size that competed: its objective, the start that it went with, the sizes, and whether they are better than
    none.
    """

    objective: float
    start: int
    sizes: tuple[float, ...]
    helps: bool = False


def _worth_following(tried: Sequence[_Tried], null: float) -> list[_Tried]:
    """The lowest of the tried sizes, no neighbours of each other; only one where none helps.

    The size nearest to `null` is the base model: where the best is no better, the size furthest from it that does no
    harm is as good a start as any.
    """
    finite = sorted((t for t in tried if np.isfinite(t.objective)), key=lambda t: round(t.objective, 3))
    if not finite:
        return []
    strength = -1.0 if np.isinf(null) else 1.0
    absent = min(finite, key=lambda t: strength * abs(t.sizes[0]))
    if finite[0].objective > absent.objective - _HELPS:
        harmless = [t for t in finite if t.objective < absent.objective + _HELPS]
        return [max(harmless, key=lambda t: strength * abs(t.sizes[0]))]
    kept: list[_Tried] = []
    for t in finite:
        apart = [
            abs(np.log(abs(t.sizes[0] / k.sizes[0]))) > _APART or t.sizes[0] * k.sizes[0] < 0 for k in kept
        ]
        if all(apart) and t.objective < absent.objective:
            kept.append(t._replace(helps=True))
        if len(kept) == _FOLLOWED:
            break
    return kept


def _starts(case: LevelCase, base: Simulated) -> list[Mapping[str, float]]:
    """Where the other parameters may begin beside a further effect.

    The modes of single levels lead a model that knows how its answer depends on the level astray.
    """
    levels = any(depends_on_level(x, case.library) for x in base.hypothesis.labels)
    return _distinct_starts((base.values,) if levels else (base.values, *case.starts))


def _distinct_starts(starts: Sequence[Mapping[str, float]]) -> list[Mapping[str, float]]:
    """Starts that differ by more than half a per cent somewhere."""
    kept: list[Mapping[str, float]] = []
    for s in starts:
        near = [all(abs(s[n] - k[n]) <= _NEAR * abs(k[n]) for n in k if n in s) for k in kept]
        if not any(near):
            kept.append(s)
    return kept


def own_floor(case: LevelCase, model: Simulated) -> NoiseFloor:
    """The floor at which a model's error is 1, within the limits of the settings."""
    s = case.settings.levels
    problem = case.problem(model.hypothesis, model.sizes)
    x = problem.space.point(model.values)[None]
    lines = problem.lines(x)

    def excess(log_own: float) -> float:
        floor = NoiseFloor(float(np.exp(log_own)), s.common_error)
        r = weighted(case.weights(floor), lines)[0]
        return float(r @ r) - case.data

    low, high = np.log(s.noise_least), np.log(s.noise_most)
    if excess(low) <= 0:
        return NoiseFloor(s.noise_least, s.common_error)
    if excess(high) >= 0:
        return NoiseFloor(s.noise_most, s.common_error)
    own = scipy.optimize.brentq(excess, low, high, xtol=0.05)
    return NoiseFloor(float(np.exp(own)), s.common_error)


class LevelRanking:
    """A base model and hypotheses on top of it, all at one floor of the noise.

    Attributes
    ----------
    base : Simulated
    fitted : list of Simulated
    probabilities : dict of str to float
        By label, ``"nothing"`` for the base model; adds up to 1.
    """

    def __init__(self, case: LevelCase, base: Simulated, fitted: Sequence[Simulated]) -> None:
        self.base = base
        self.fitted = list(fitted)
        s = case.settings
        prior = prior_probabilities([f.hypothesis for f in fitted], s.null_prior, s.parameter_prior)
        evidence = {NOTHING: base.evidence}
        for f in fitted:
            # a richer model holds the poorer one; its evidence cannot grow by more than the likelihood does
            least = base.evidence + min(f.fit.objective - base.fit.objective, 0.0)
            evidence[f.hypothesis.label] = max(f.evidence, least)
        logs = {label: np.log(max(prior[label], 1e-300)) - 0.5 * e for label, e in evidence.items()}
        top = max(logs.values())
        weights = {label: float(np.exp(v - top)) for label, v in logs.items()}
        total = sum(weights.values())
        self.evidence = evidence
        self.probabilities = {label: w / total for label, w in weights.items()}

    def ordered(self) -> list[Simulated]:
        """The most probable first."""
        return sorted(self.fitted, key=lambda f: -self.probabilities[f.hypothesis.label])

    def gain(self, f: Simulated) -> float:
        """Fall of -2 log posterior."""
        return self.base.fit.objective - f.fit.objective

    def log_evidence(self, f: Simulated) -> float:
        """Natural logarithm of the Bayes factor against the base model."""
        return 0.5 * (self.base.evidence - self.evidence[f.hypothesis.label])


def ranked(case: LevelCase, base: Simulated, floor: NoiseFloor, tell: Progress) -> LevelRanking:
    """Fits of all hypotheses that depend on the level on top of a base model at one floor."""
    hypotheses = level_hypotheses(case, base.hypothesis)
    windows = Growing(case, floor, base)
    fitted = _each(lambda h: fit_effect(windows, h, base), hypotheses, case, tell)
    return polished(case, LevelRanking(case, base, fitted), floor)


def ranked_linear(case: LevelCase, base: Simulated, floor: NoiseFloor, tell: Progress) -> LevelRanking:
    """The same of the effects that do not depend on the level."""
    configurations = [w.configuration for w in case.windows]
    hypotheses = single_hypotheses(case.rig, configurations, case.library, base.hypothesis, parameters=False)
    windows = Growing(case, floor, base)
    fitted = _each(lambda h: fit_linear(windows, h, base), hypotheses, case, tell)
    return polished(case, LevelRanking(case, base, fitted), floor)


def _each(
    job: Callable[[Hypothesis], Simulated | None],
    hypotheses: Sequence[Hypothesis],
    case: LevelCase,
    tell: Progress,
) -> list[Simulated]:
    found = []
    for k, f in enumerate(spread(job, hypotheses, case.settings.processes)):
        tell(0.9 * (k + 1) / len(hypotheses), hypotheses[k].labels[-1])
        if f is not None and np.isfinite(f.fit.objective):
            found.append(f)
    return found


def polished(case: LevelCase, ranking: LevelRanking, floor: NoiseFloor) -> LevelRanking:
    """The same with the best fits followed to the end, and the base model from where they led as well.

    What a hypothesis gained by another rig alone, the base model gains too.
    """
    ordered = ranking.ordered()
    coarse = case.coarse()
    best = [again(case, again(coarse, m, floor, _MOST_STEPS), floor) for m in ordered[:_POLISHED]]
    base = ranking.base
    if best:
        top = min(best, key=lambda m: m.fit.objective)
        problem = case.problem(base.hypothesis, base.sizes)
        found = fit(problem, case.weights(floor), problem.space.point(top.values), _MOST_STEPS)
        if found.objective < base.fit.objective:
            base = judged(problem, base.hypothesis, base.sizes, found)
    return LevelRanking(
        case, base, [*(m for m in best if np.isfinite(m.fit.objective)), *ordered[_POLISHED:]]
    )


def at_floor(case: LevelCase, ranking: LevelRanking, floor: NoiseFloor, tell: Progress) -> LevelRanking:
    """The same ranking at another floor, every fit from its own optimum; those without a solution left out.

    Those that cannot come back are judged where they are; all but the base model and the best try the slopes of the
    base model first.
    """
    models = [ranking.base, *ranking.fitted]
    least = min(m.evidence for m in models) + _HOPELESS
    slopes = slopes_of(case, case.weights(floor), ranking.base)
    best = [ranking.base, *ranking.ordered()[:_POLISHED]]

    def job(m: Simulated) -> Simulated:
        steps = _AGAIN if m is ranking.base or m.evidence < least else 0
        return again(case, m, floor, steps, {} if any(m is b for b in best) else slopes)

    fitted = []
    for f in spread(job, models, case.settings.processes):
        fitted.append(f)
        tell(len(fitted) / len(models), f.hypothesis.label)
    return LevelRanking(case, fitted[0], [m for m in fitted[1:] if np.isfinite(m.fit.objective)])
