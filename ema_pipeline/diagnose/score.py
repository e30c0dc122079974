"""The gain in evidence that is expected of an effect to first order: one step from the current model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import Hypothesis
from ema_pipeline.effects.base import effect_of
from ema_pipeline.inference import lower_factor
from ema_pipeline.observations.base import EffectProblem, Observations
from ema_pipeline.observations.fitting import Fit, Model, transferred
from ema_pipeline.processes import spread

UNSEEN = 1e6
"""1 σ of a size, in units of its prior, above which the data carry no information on it."""
_WORTH = 40
"""Hypotheses from which processes are worth it: each takes some milliseconds."""
_SMALL = 0.01
"""Unknown of a first size in proportion to which the residuals change."""


@dataclass(frozen=True)
class Score:
    """Linearised posterior of one effect's size about its null.

    Attributes
    ----------
    hypothesis : Hypothesis
    size : ndarray, (k,)
        Estimate of its unknowns, in units of their prior σ; all but the first are those of the usual ones that gain
        most, where they only matter beside it (the angle of a stiff axis).
    std : float
        1 σ of the first unknown from the data alone, everything else uncertain; infinite where they say nothing.
    gain : float
        Expected log evidence gained.
    """

    hypothesis: Hypothesis
    size: NDArray[np.float64]
    std: float
    gain: float


def scores(
    observations: Observations,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    models: Mapping[str, Model] | None = None,
    processes: int | None = 1,
) -> list[Score]:
    """Scores of hypotheses on top of a fitted model; those whose size cannot be zero are left out.

    Parameters
    ----------
    observations : Observations
    base : Fit
    hypotheses : sequence of Hypothesis
    models : dict of str to Model, optional
        The base model with each hypothesis, by its label, where they are at hand.
    processes : int or None
        Processes that share the hypotheses, None for one per processor.
    """
    marginal = Marginal(base)
    asked = [h for h in hypotheses if not h.size_cannot_be_zero]
    models = models or {h.label: base.model.plus(h.placed, h.scales) for h in asked}
    columns = first_order_changes(observations, base, [h for h in asked if not h.has_direction], models)
    matching, scatters = base.posterior.residuals.matching, base.posterior.scatters

    def told(hypothesis: Hypothesis) -> tuple[NDArray[np.float64], float, float] | None:
        """Size, σ and gain; None where the effect changes what is compared."""
        label = hypothesis.label
        problem, by_size = models[label].problem(observations), columns.get(label)
        at = [problem.unknowns.index[name] for name in problem.sizes if effect_of(name) == label]
        start = transferred(base.posterior, problem.unknowns)
        if hypothesis.has_direction:
            return along_best(problem, start, at, hypothesis.starts())
        if by_size is None:
            by_size = problem.residuals(start, scatters, matching=matching).jacobian[:, at]
        if len(by_size) != marginal.count:
            return None
        return marginal.score(by_size * marginal.weight[:, None], problem.unknowns.lower[at])

    def along_best(
        problem: EffectProblem,
        begin: NDArray[np.float64],
        at: Sequence[int],
        starts: Sequence[Mapping[str, float]],
    ) -> tuple[NDArray[np.float64], float, float] | None:
        """The same of the first size beside those others, of some, with which it is seen and gains most."""
        found = []
        for start in starts:
            x = problem.unknowns.with_values(begin, start)
            x[at[0]] = _SMALL
            there = problem.residuals(x, scatters, matching=matching, derivatives=False)
            if len(there.values) == marginal.count:
                change = (there.values - base.posterior.residuals.values) * marginal.weight / _SMALL
                size, std, gain = marginal.score(change[:, None], problem.unknowns.lower[at[:1]])
                found.append((np.concatenate([size, x[at[1:]]]), std, gain))
        return max(found, key=lambda one: (one[1] < UNSEEN, one[2]), default=None)

    alone = [h for h in asked if h.label not in columns]
    scored = {h.label: told(h) for h in asked if h.label in columns}
    scored |= zip([h.label for h in alone], spread(told, alone, processes, _WORTH), strict=True)
    return [Score(h, *one) for h in asked if (one := scored[h.label]) is not None]


def first_order_changes(
    observations: Observations, base: Fit, hypotheses: Sequence[Hypothesis], models: Mapping[str, Model]
) -> dict[str, NDArray[np.float64]]:
    """How the sizes of effects change the residuals of a model without them, (m, k) each, by label.

    All at once; without those that have to be calculated one by one.
    """
    added = [models[h.label].problem(observations) for h in hypotheses]
    found = base.model.problem(observations).first_order(base.posterior, added)
    return {h.label: columns for h, columns in zip(hypotheses, found, strict=True) if columns is not None}


class Marginal:
    """Residual and information of new directions once everything that is uncertain already is allowed for.

    Parameters
    ----------
    base : Fit
    without : str
        Label of an effect of the model whose sizes are not counted among what is uncertain.
    """

    def __init__(self, base: Fit, without: str = "") -> None:
        p = base.posterior
        self.residual, jacobian = p.residuals.weighted
        self.weight, self.count = p.residuals.weight, len(self.residual)
        self.kept = np.array([not without or effect_of(n) != without for n in p.unknowns.names], bool)
        self.whitened = (jacobian * p.prior_std)[:, self.kept]
        information = np.eye(self.whitened.shape[1]) + self.whitened.T @ self.whitened
        self.factor = lower_factor(information), True
        # Zero at the maximum, which a fit of repeated modes need not have reached to the last bit.
        ascent = self.whitened.T @ self.residual + (p.x / p.prior_std)[self.kept]
        to_maximum = scipy.linalg.cho_solve(self.factor, ascent, check_finite=False)
        self.at_maximum = self.residual - self.whitened @ to_maximum

    def information(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fisher information of weighted directions, the rest marginalised, (k, k)."""
        shared = self.whitened.T @ columns
        solved = scipy.linalg.cho_solve(self.factor, shared, check_finite=False)
        return np.asarray(columns.T @ columns - shared.T @ solved)

    def left(self, change: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What a change of the residuals, (m,), leaves of them when all that is uncertain has followed it.

        Returns
        -------
        residuals : ndarray, (m,)
        unknowns : ndarray, (n,)
            How far they have moved, in units of their prior σ.
        """
        weighted = change * self.weight
        moved = -scipy.linalg.cho_solve(self.factor, self.whitened.T @ weighted, check_finite=False)
        return weighted + self.whitened @ moved, moved

    def gained(self, change: NDArray[np.float64]) -> float:
        """Log density that a change of the residuals, (m,), gains when all that is uncertain has followed it."""
        weighted = change * self.weight
        return -float(self.at_maximum @ weighted) - 0.5 * float(weighted @ self.left(change)[0])

    def score(
        self, columns: NDArray[np.float64], lower: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float, float]:
        """Size, σ and gain of an effect, from the base model's maximum, to first order; see `Score`."""
        information = self.information(columns)
        precision = information + np.eye(len(information))
        slope = -columns.T @ self.at_maximum
        size = np.linalg.solve(precision, slope)
        if size[0] < lower[0]:
            size = np.zeros_like(size)
        gain = 0.5 * float(slope @ size) - 0.5 * float(np.linalg.slogdet(precision)[1])
        std = float(1 / np.sqrt(max(information[0, 0], 1e-300)))
        return np.asarray(size, float), std, gain
