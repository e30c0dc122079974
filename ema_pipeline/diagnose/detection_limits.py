"""What these data would have shown: the least size of every effect that would be claimed in nine tests of ten.

Of an effect that shows the more the smaller its size is, it is the largest one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.diagnose.claims import evidence_beyond, sigmas_asked
from ema_pipeline.diagnose.expected_gain import Change, ExpectedGain
from ema_pipeline.diagnose.hypotheses import Hypothesis, Name
from ema_pipeline.diagnose.probability import needed
from ema_pipeline.diagnose.score import UNSEEN, Marginal, first_order_changes
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import DetectionLimit
from ema_pipeline.effects.base import effect_of
from ema_pipeline.inference import Posterior, Residuals, lower_factor, same_matching
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.fitting import Fit, Model, transferred
from ema_pipeline.observations.size_map import LOG_STD, SizeMap
from ema_pipeline.observations.without_partner import UNEXPLAINED
from ema_pipeline.processes import spread

_NINE_OF_TEN = 1.2816
"""Quantile of the normal distribution: in nine tests of ten the estimate is no further than this below the truth."""
_TRIALS, _MOST_TRIALS = 5, 14
"""Sizes that are tried, of effects in proportion to their size and of others."""
_NEAR = 0.1
"""Relative accuracy of the gain at a limit."""
_LARGEST_STEP, _LONGEST_STEP = 1.4, 4.0
"""Largest step in the logarithm of a limit from one trial to the next, of the same."""
_SMOOTH = 30.0
"""How much more a claimed effect may change the residuals to first order than it does, where it has a slope at all."""
_BENT = 1.5
"""Squared distance as calculated over that to first order, above which what is uncertain has to follow step by step."""
_FOLLOWED, _SETTLED = 6, 0.8
"""Such steps, and the share of the squared distance that the next one leaves where they have settled."""
_FURTHEST = 10.0
"""Prior σ beyond which no unknown follows: what that made of the model would be none."""
_NEARER = (0.4, 0.15, 0.05)
"""Shares of a size that are tried where it is too large to be followed."""
_NEARLY = -1.0
"""Logarithm of what is gained there over what is asked, from which the limit is sought about that size."""
_SLOPES = (0.3, 5.0)
"""Least and largest power of the size with which the gain is taken to grow."""
_DECADES = 4
"""Of sizes, about the usual one, among which the largest is sought that shows."""
_HALVINGS = 3
"""Of the last step of that search, from one size to half of it."""


def detection_limits(
    observations: Observations,
    fit: Fit,
    hypotheses: Sequence[Hypothesis],
    settings: DiagnoseSettings,
    some: Sequence[Hypothesis] | None = None,
    found: int = 0,
) -> tuple[DetectionLimit, ...]:
    """Limit of every effect, from what the data say of its size beside everything uncertain.

    Its expected gain in log evidence (`ExpectedGain`), less what its freedom costs, ½ ln(1 + (prior σ/σ)²), has to be
    as much as a claim needs among so many hypotheses. How far an effect moves the predictions is calculated at its
    size: twice the damper does not move ln ζ twice as far.

    Parameters
    ----------
    observations : Observations
    fit : Fit
        The model that explains the data; an effect that it has already is held against the model without it.
    hypotheses : sequence of Hypothesis
        All that compete.
    settings : DiagnoseSettings
    some : sequence of Hypothesis, optional
        Those that are asked about; all where left out.
    found : int
        Effects of the model that were claimed: beside them more is asked.
    """
    had = set(fit.model.labels)
    asked = hypotheses if some is None else some
    asked = [h for h in asked if h.shown_by_less or not h.size_cannot_be_zero]
    more = any(h.label not in had for h in asked)
    whole = ExpectedGain(fit.posterior, observations.scatters, Marginal(fit)) if more else None
    models = {h.label: fit.model if h.label in had else fit.model.plus(h.placed, h.scales) for h in asked}
    added = [h for h in asked if h.label not in had and not h.shown_by_less]
    changes = first_order_changes(observations, fit, added, models)

    def limit(hypothesis: Hypothesis) -> float | None:
        label = hypothesis.label
        gains = None if label in had else whole
        shown = _Shown.of(observations, fit, models[label], hypothesis, gains, changes.get(label))
        if shown is None:
            return None
        sigmas = sigmas_asked(observations, hypothesis, settings)
        evidence = needed(hypothesis, hypotheses, settings, max(found - (label in had), 0))
        evidence += evidence_beyond(observations, hypothesis, settings)
        return shown.largest(evidence) if hypothesis.shown_by_less else shown.least(evidence, sigmas)

    told = zip(asked, spread(limit, asked, settings.processes), strict=True)
    return tuple(_under(name, h, size) for h, size in told if size is not None for name in h.names)


def _under(name: Name, hypothesis: Hypothesis, unknown: float) -> DetectionLimit:
    """The limit as a size of one name."""
    own = name.placed.effect.parameters[0]
    size = SizeMap.of(own, name.scales.get(own.name, own.scale))
    if hypothesis.shown_by_less:
        most = size.value(unknown) if np.isfinite(unknown) else 0.0
        return DetectionLimit(name.label, own.name, most, own.unit, largest=True)
    least = abs(size.slope(0.0)) * unknown * hypothesis.representative.relative / name.relative
    seen = least <= own.maximum - own.null
    return DetectionLimit(name.label, own.name, least if seen else float("inf"), own.unit)


@dataclass(frozen=True)
class _Shown:
    """How far one effect moves the predictions.

    Attributes
    ----------
    problem : EffectProblem
    null : ndarray, (n,)
        Unknowns with the effect at zero.
    at : int
        Position of its first size.
    scatters : dict of str to float
    before : Residuals
        At `null`.
    slope : ndarray, (m,)
        Their derivatives by the size.
    gains : ExpectedGain
    std : float
        1 σ of the unknown at zero; of an effect that depends on the amplitude, as its usual size shows it.
    linear : bool
        False for such an effect: how it begins says little of it. What a quadratic spring changes grows with the
        square of its size.
    """

    problem: EffectProblem
    null: NDArray[np.float64]
    at: int
    scatters: Mapping[str, float]
    before: Residuals
    slope: NDArray[np.float64]
    gains: ExpectedGain
    std: float
    linear: bool

    @classmethod
    def of(
        cls,
        observations: Observations,
        fit: Fit,
        model: Model,
        hypothesis: Hypothesis,
        gains: ExpectedGain | None,
        changes: NDArray[np.float64] | None = None,
    ) -> _Shown | None:
        """Of one hypothesis; None where these data carry no information on it.

        `gains` is None for an effect that the fit has already: its gain is that on top of the rig without it.
        `changes` are those of the fit's residuals by its sizes, (m, k), where they are known.
        """
        problem, scatters = model.problem(observations), fit.posterior.scatters
        null = transferred(fit.posterior, problem.unknowns)
        size = hypothesis.placed.effect.parameters[0].name
        at = problem.unknowns.index[hypothesis.placed.parameter_name(size)]
        null[at] = problem.unknowns.upper[at] if hypothesis.shown_by_less else 0.0
        null = problem.uninterpolated(null)
        before = fit.posterior.residuals
        if changes is None:
            before = problem.residuals(null, scatters, matching=before.matching)
        if gains is None:
            if _not_there(before, fit.posterior, at):
                before = problem.residuals(null, scatters)
            gains = _without(observations, fit, hypothesis, null, before)
        if len(before.values) != gains.marginal.count or not np.all(np.isfinite(before.values)):
            return None
        slope = before.jacobian[:, at] if changes is None else changes[:, 0]
        if hypothesis.shown_by_less:
            return cls(problem, null, at, scatters, before, slope, gains, 1.0, linear=False)
        linear, usual = hypothesis.placed.effect.linear, slope
        if not linear:
            x = null.copy()
            x[at] = 1.0
            usual = problem.residuals(x, scatters, matching=before.matching, derivatives=False).values
            usual = (
                usual - before.values if len(usual) == len(before.values) else np.zeros_like(before.values)
            )
        std = 1 / np.sqrt(max(gains.change(np.nan_to_num(usual)).total, 1e-300))
        if std > UNSEEN:
            return None
        return cls(problem, null, at, scatters, before, slope, gains, float(std), linear)

    def least(self, gain: float, sigmas: float) -> float:
        """Unknown of the least size that gains so much in nine tests of ten; infinite where none does."""
        most = float(self.problem.unknowns.upper[self.at])
        unknown = self.std * (np.sqrt(2 * self._wanted(gain, sigmas, 1 / self.std)) + _NINE_OF_TEN)
        trials, longest = (_TRIALS, _LARGEST_STEP) if self.linear else (_MOST_TRIALS, _LONGEST_STEP)
        low, high = 0.0, np.inf
        known: list[tuple[float, float]] = []
        for trial in range(trials):
            unknown = min(unknown, most)
            off, sure = self._above(unknown, gain, sigmas)
            if trial == 0 and self.linear and not sure:
                unknown, off = self._nearer(unknown, off, gain, sigmas)
            if abs(off) < _NEAR or (unknown == most and off < 0):
                break
            low, high = (unknown, high) if off < 0 else (low, unknown)
            log, slope = float(np.log(unknown)), 2.0
            if known and log != known[-1][0]:
                slope = float(np.clip((off - known[-1][1]) / (log - known[-1][0]), *_SLOPES))
            known.append((log, off))
            unknown = float(np.exp(log - np.clip(off / slope, -longest, longest)))
            if not low < unknown < high:
                unknown = float(np.sqrt(low * high))
        return unknown if unknown < most or off >= 0 else float("inf")

    def _nearer(self, unknown: float, off: float, gain: float, sigmas: float) -> tuple[float, float]:
        """A smaller unknown that surely shows, or nearly, if there is one, where of the first one that is not known."""
        for share in _NEARER:
            above, sure = self._above(share * unknown, gain, sigmas)
            if sure:
                return (share * unknown, above) if above > _NEARLY else (unknown, off)
        return unknown, off

    def largest(self, gain: float) -> float:
        """Unknown of the largest size that gains so much in nine tests of ten; -infinite where none does."""

        def shows(unknown: float) -> bool:
            gained, distance = self._gained_at(unknown)
            return gained >= self._wanted(gain, 0.0, distance)

        half = float(np.log(2) / LOG_STD)
        reach = 0.5 * _DECADES * np.log(10) / LOG_STD
        for unknown in np.arange(reach, -reach, -half):
            if shows(float(unknown)):
                low, high = float(unknown), float(unknown) + half
                for _ in range(_HALVINGS):
                    middle = 0.5 * (low + high)
                    low, high = (middle, high) if shows(middle) else (low, middle)
                return low
        return -float("inf")

    def _above(self, unknown: float, gain: float, sigmas: float) -> tuple[float, bool]:
        """Logarithm of what a size gains in nine tests of ten, over what is asked of it; False where it may be more.

        What is uncertain follows an effect to first order. Where an effect that shows would not do so to first order,
        this says nothing: close modes turn into each other in ways that a fit would follow, and a damper bends shapes
        with the square of its size. Everything then follows as in a fit. Of a damper of one of four like planets
        2.6 N·s/m gained 240, and 14 would have shown to first order.
        """

        def over(change: Change) -> float:
            gained, distance = self._gained(change)
            known = 1 / self.std if self.linear else distance / unknown
            return float(np.log(max(gained, 1e-9) / self._wanted(gain, sigmas, known)))

        first, begin, change = self._moved(unknown)
        added = self.problem.modes_added(self.null, begin) if self.linear else 0
        if added:  # without the effect these would find no partner
            return float(np.log(UNEXPLAINED * added / self._wanted(gain, sigmas, 1 / self.std))), True
        whole = first if change is None else self.gains.change(change)
        if change is None or not self.linear:
            return over(whole), change is not None
        off, most = over(first), over(whole)
        if whole.total < _BENT * first.total or off > _NEAR:
            return min(off, most), True
        if most < 0:  # not even so
            return most, True
        followed = self._followed(begin, change)
        return (off, False) if followed is None else (over(followed), True)

    def _gained_at(self, unknown: float) -> tuple[float, float]:
        """The same as `_gained`, of a size as calculated."""
        first, _, change = self._moved(unknown)
        return self._gained(first if change is None else self.gains.change(change))

    def _gained(self, change: Change) -> tuple[float, float]:
        """Log evidence that a change gains in nine tests of ten, and how far it is, in σ."""
        distance = float(np.sqrt(max(change.total, 1e-300)))
        return self.gains.of(change, max(1 - _NINE_OF_TEN / distance, 0.0) ** 2), distance

    @staticmethod
    def _wanted(gain: float, sigmas: float, known: float) -> float:
        """Log evidence asked of a size that the data know `known` times better than its prior."""
        return max(gain + 0.5 * float(np.log1p(known**2)), 0.5 * sigmas**2)

    def _moved(self, unknown: float) -> tuple[Change, NDArray[np.float64], NDArray[np.float64] | None]:
        """How far a size moves the predictions to first order, all unknowns with it, and how it changes the residuals;
        None for these where modes have other partners there.
        """
        first = self.gains.change(self.slope * unknown)
        x = self.null.copy()
        x[self.at] = unknown
        x = self.problem.uninterpolated(x)
        there = self.problem.residuals(x, self.scatters, derivatives=False)
        return first, x, there.values - self.before.values if self._as_before(there) else None

    def _as_before(self, there: Residuals) -> bool:
        return same_matching(there.matching, self.before.matching) and bool(np.all(np.isfinite(there.values)))

    def _followed(self, begin: NDArray[np.float64], change: NDArray[np.float64]) -> Change | None:
        """How far the predictions move once everything uncertain has followed, in Gauss-Newton steps.

        None where these do not settle.

        Parameters
        ----------
        begin : ndarray, (n,)
            With the effect, everything else as it was.
        change : ndarray, (m,)
            Of the residuals there.
        """
        weight, u = self.gains.marginal.weight, self.problem.unknowns
        effect = effect_of(u.names[self.at])
        free = np.array([effect_of(name) != effect for name in u.names])
        std = u.prior_std(self.scatters)[free]
        aim = self.gains.marginal.left(change)[1]
        for _ in range(_FOLLOWED):
            if not np.all(np.abs(aim) < _FURTHEST):
                return None
            x = begin.copy()
            x[free] += std * aim
            x = u.clipped(x)
            there = self.problem.residuals(x, self.scatters)
            if not self._as_before(there):
                return None
            left, moved = (there.values - self.before.values) * weight, (x - begin)[free] / std
            columns = there.jacobian[:, free] * std * weight[:, None]
            factor = lower_factor(np.eye(len(std)) + columns.T @ columns), True
            step = -scipy.linalg.cho_solve(factor, columns.T @ left + moved, check_finite=False)
            now, aim = self.gains.of_moved(left, moved), moved + step
            if self.gains.of_moved(left + columns @ step, aim).total > _SETTLED * now.total:
                return now
        return None


def _not_there(before: Residuals, fit: Posterior, at: int) -> bool:
    """True where an effect that the fit has makes a mode of what is none without it, as a shaft's torsion does.

    The logarithm of a frequency that begins at 0 Hz has no slope there.
    """
    change = float(np.max(np.abs(fit.residuals.values - before.values), initial=0.0))
    return float(np.max(np.abs(before.jacobian[:, at] * fit.x[at]), initial=0.0)) > _SMOOTH * change


def _without(
    observations: Observations,
    fit: Fit,
    hypothesis: Hypothesis,
    null: NDArray[np.float64],
    before: Residuals,
) -> ExpectedGain:
    """Gains on top of the rig without an effect that the fit has, were it what was measured.

    What is uncertain is followed from there: modes that nearly coincide without the effect move otherwise than with it.
    The data would leave over what they leave of the fit; where modes have other partners, one standard deviation.
    """
    left = fit.posterior.residuals
    if not same_matching(before.matching, left.matching):
        exact = replace(before, values=np.zeros(len(before.values)))
        followed = replace(fit.posterior, x=null, residuals=exact).expected_squares(weighted=False)
        left = replace(before, values=np.sqrt(np.maximum(1.0 - followed, 0.0)))
    there = replace(
        fit, posterior=replace(fit.posterior, x=null, residuals=replace(left, jacobian=before.jacobian))
    )
    return ExpectedGain(there.posterior, observations.scatters, Marginal(there, without=hypothesis.label))
