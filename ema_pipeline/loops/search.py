"""Which set of effects do the loops ask for? Evidence of sets, and the search through them.

Effects of an isolator act together, and one alone often looks like another: so hypotheses are sets. All sets near
the most probable ones are fitted in full, and evidence is Laplace's, with priors in the loops' own units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.effects import DISSIPATIVE, Structure
from ema_pipeline.loops.fitting import RANGES, SYSTEMATIC, Fitted, fit
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.model import EXPONENT, GAP, GAPS, SPRING_GAP, STIFFNESS

Progress = Callable[[float, str], None]

_KEPT = 3
_SHARPER = 8.0


@dataclass(frozen=True)
class Ranking:
    """Fitted sets of effects on top of a base, the most probable first.

    Attributes
    ----------
    loops : LoopSet
    base : tuple of str
        Effects that all sets hold.
    fitted : dict of frozenset to Fitted
    log_evidence : dict of frozenset to float
        Against the base.
    log_posterior : dict of frozenset to float
        Evidence times prior, not normalised.
    probabilities : dict of frozenset to float
        Add up to 1.
    widening : float
        By how much the variance of the residuals exceeds that of independent noise, as the best models leave them.
    """

    loops: LoopSet
    base: tuple[str, ...]
    fitted: dict[frozenset[str], Fitted]
    log_evidence: dict[frozenset[str], float]
    log_posterior: dict[frozenset[str], float]
    probabilities: dict[frozenset[str], float]
    widening: float

    @property
    def best(self) -> Fitted:
        """The most probable set."""
        return self.fitted[max(self.probabilities, key=lambda k: self.probabilities[k])]

    def gain(self, key: frozenset[str], effect: str) -> float:
        """Fall of the sum of squares by an effect of a set, in widened variances."""
        return (self.fitted[key - {effect}].chi2 - self.fitted[key].chi2) / self.widening

    def threshold(self, key: frozenset[str], effect: str, probability: float) -> float:
        """Gain at which the set with the effect has `probability` against the one without."""
        odds = self.log_posterior[key] - self.log_posterior[key - {effect}]
        return self.gain(key, effect) + 2 * (float(np.log(probability / (1 - probability))) - odds)

    def share(self, effect: str) -> float:
        """Probability of all sets that hold an effect."""
        return float(sum(p for k, p in self.probabilities.items() if effect in k))


def rank(
    loops: LoopSet,
    base: Sequence[str],
    effects: Sequence[str],
    null_prior: float,
    progress: Progress | None = None,
) -> Ranking:
    """Fit the sets of effects that the loops may ask for.

    Parameters
    ----------
    loops : LoopSet
    base : sequence of str
        Effects that the model has already.
    effects : sequence of str
        Effects that it may be missing.
    null_prior : float
        Prior probability that nothing is missing.
    progress : callable, optional

    Notes
    -----
    From the base on, effects are added to and taken from the three most probable sets until none of their
    neighbours is left to be tried; in the best set each effect is also replaced by each other one.
    """
    tell = progress or (lambda share, text: None)
    fitted: dict[frozenset[str], Fitted] = {}
    most = 12 + 4 * len(effects)

    def add(structure: Structure, start: Mapping[str, float] | None) -> None:
        fitted[structure.key] = fit_variants(loops, structure, start)
        tell(min(0.98, len(fitted) / most), " + ".join(structure.effects) or "linear spring")

    add(Structure(tuple(base)), None)
    while True:
        evidence, _ = _evidence(loops, fitted, base, effects, null_prior)
        leaders = sorted(fitted, key=lambda k: -evidence[k])[:_KEPT]
        new = next((key for key in _around(leaders, effects) if key not in fitted), None)
        if new is None:
            break
        near = _nearest(fitted, new)
        order = [e for e in near.structure.effects if e in new]
        add(Structure((*order, *(e for e in effects if e in new and e not in order))), near.values)
    posterior, widening = _evidence(loops, fitted, base, effects, null_prior)
    top = max(posterior.values())
    weights = {k: float(np.exp(v - top)) for k, v in posterior.items()}
    total = sum(weights.values())
    prior, null = _prior(base, effects, null_prior), frozenset(base)
    return Ranking(
        loops=loops,
        base=tuple(base),
        fitted=fitted,
        log_evidence={k: v - prior(k) - posterior[null] + prior(null) for k, v in posterior.items()},
        log_posterior=posterior,
        probabilities={k: w / total for k, w in sorted(weights.items(), key=lambda item: -item[1])},
        widening=widening,
    )


def widening_of(fitted: Fitted, loops: LoopSet) -> float:
    """Variance of the residuals' mean over that of independent noise; 1 where the model reaches the noise.

    A model that does not leaves residuals that go together from point to point, so that the points count for less.
    """
    reduced = fitted.chi2 / max(loops.freedom - fitted.jacobian.shape[1], 1)
    if reduced < SYSTEMATIC:
        return max(1.0, reduced)
    return float(reduced * np.mean([_correlation(fitted.residual[part]) for part in loops.parts]))


def _correlation(residual: NDArray[np.float64]) -> float:
    """Points of a loop that count as one: the sum of the autocorrelation up to where it first vanishes."""
    spectrum = np.abs(np.fft.fft(residual)) ** 2
    correlation = np.fft.ifft(spectrum).real
    if correlation[0] <= 0:
        return 1.0
    half = correlation[1 : len(residual) // 2] / correlation[0]
    ends = np.flatnonzero(half <= 0)
    return float(1 + 2 * np.sum(half[: ends[0] if len(ends) else len(half)]))


def fit_variants(loops: LoopSet, structure: Structure, start: Mapping[str, float] | None) -> Fitted:
    """The fit, with another kind of play or a free exponent of the hysteresis where the loops ask for it clearly."""
    effects, begin = structure.effects, dict(start or {})
    if SPRING_GAP in begin:
        begin.setdefault(GAP, begin[SPRING_GAP])
    best = fit(loops, Structure(effects), begin)
    if "backlash" in effects and set(effects) & set(DISSIPATIVE):
        begin.setdefault(SPRING_GAP, best.values[GAP])
        best = _clearly_better(loops, best, fit(loops, Structure(effects, spring_play=True), begin))
    if "hysteresis" in effects:
        sharp = replace(best.structure, free_exponent=True)
        known = {EXPONENT: begin[EXPONENT]} if EXPONENT in begin else {}
        best = _clearly_better(loops, best, fit(loops, sharp, best.values | known, grid=False))
    return best


def _clearly_better(loops: LoopSet, plain: Fitted, other: Fitted) -> Fitted:
    return other if plain.chi2 - other.chi2 > _SHARPER * widening_of(other, loops) else plain


def _around(leaders: Sequence[frozenset[str]], effects: Sequence[str]) -> Iterator[frozenset[str]]:
    """Sets with one effect more or less than a leader, then those with one of the best set's replaced."""
    for key in leaders:
        for effect in effects:
            yield key ^ {effect}
    best = leaders[0]
    for old in (e for e in effects if e in best):
        for other in (e for e in effects if e not in best):
            yield best - {old} | {other}


def _nearest(fitted: Mapping[frozenset[str], Fitted], key: frozenset[str]) -> Fitted:
    """The best fit among those that differ least from a set."""
    least = min(len(k ^ key) for k in fitted)
    return min((f for k, f in fitted.items() if len(k ^ key) == least), key=lambda f: f.chi2)


def _prior(
    base: Sequence[str], effects: Sequence[str], null_prior: float
) -> Callable[[frozenset[str]], float]:
    """Logarithm of a set's prior probability: every effect is missing by itself or not."""
    one = 1 - null_prior ** (1 / max(len(effects), 1))

    def log_prior(key: frozenset[str]) -> float:
        count = len(key) - len(base)
        return float(count * np.log(one) + (len(effects) - count) * np.log1p(-one))

    return log_prior


def _evidence(
    loops: LoopSet,
    fitted: Mapping[frozenset[str], Fitted],
    base: Sequence[str],
    effects: Sequence[str],
    null_prior: float,
) -> tuple[dict[frozenset[str], float], float]:
    """Logarithm of evidence times prior of all sets, and the widening that they share."""
    least = min(fitted.values(), key=lambda f: f.chi2)
    widening = widening_of(least, loops)
    prior = _prior(base, effects, null_prior)
    return {k: log_evidence(loops, f, widening) + prior(k) for k, f in fitted.items()}, widening


def log_evidence(loops: LoopSet, fitted: Fitted, widening: float) -> float:
    """Laplace's logarithm of the evidence.

    Linear parameters have normal priors about zero, as wide as would make a force like the measured one; the
    spring's is common to all models. Shapes are uniform over their ranges in logarithm, the play over its range.
    """
    names = fitted.names
    to_unit = np.array([_unit(loops, fitted, n) for n in names])
    n = len(names)
    j = fitted.jacobian.copy()
    j[:, :n] *= to_unit
    curvature = j.T @ j / widening
    value = -0.5 * fitted.chi2 / widening
    for k, name in enumerate(names):
        if name in RANGES:
            low, high = RANGES[name]
            width = high - low if name in GAPS else float(np.log(high / low))
            curvature[k, k] += 12 / width**2  # a range is never wider than the prior's
            value -= float(np.log(width))
        elif name != STIFFNESS:
            size = fitted.values[name] / loops.units[name]
            curvature[k, k] += 1.0
            value -= 0.5 * float(size**2) + 0.5 * float(np.log(2 * np.pi))
    _, determinant = np.linalg.slogdet(curvature)
    return float(value + 0.5 * n * np.log(2 * np.pi) - 0.5 * determinant)


def _unit(loops: LoopSet, fitted: Fitted, name: str) -> float:
    if name in loops.units:
        return loops.units[name]
    return loops.shape_unit(name) if name in GAPS else fitted.values[name]
