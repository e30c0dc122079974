"""Fit of one hypothesis: all parameters again, from several starts, never worse than the model without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.descents import (
    best_distinct,
    descend_rungs,
    first_steps,
    honest,
    insisting,
    keeping_one,
    settle,
    straight,
)
from ema_pipeline.diagnose.frequencies import finer_grid, searched_starts
from ema_pipeline.diagnose.hypotheses import Extra, Hypothesis, extras, make_rig, starting_points
from ema_pipeline.diagnose.scan import likeliest, scanned
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.tuned import tuned_sizes
from ema_pipeline.diagnose.weighing import lonely_cost, missed_modes, mixing_volume, occam
from ema_pipeline.effects.library import Library
from ema_pipeline.fit.map_fit import posterior_covariance
from ema_pipeline.fit.matrices import MatrixFamily
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, Optimum, prepare, refine, search
from ema_pipeline.fit.space import Space
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Rig

_CLEAR_GAIN = 30.0
_NEAR = 20.0
_PROMISE = 3.0
_HOLDS = 4.0
_SHARES = (0.05, 0.3)


@dataclass(frozen=True)
class Case:
    """What a diagnosis works on.

    Attributes
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
    settings : DiagnoseSettings
    library : mapping of id to Effect, or None for the shipped one
    """

    rig: Rig
    measured: Mapping[str, MeasuredModes]
    settings: DiagnoseSettings
    library: Library | None = None
    families: dict[tuple[str, ...], dict[str, MatrixFamily]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """Matrices of the hypotheses' rigs, by their effects and configuration: made once."""

    def rig_of(self, hypothesis: Hypothesis) -> ParametricRig:
        """The rig of a hypothesis, without anything prepared for a fit."""
        return make_rig(self.rig, hypothesis, self.library, self.settings.parameter_range)

    def problem(
        self,
        hypothesis: Hypothesis,
        fit: FitSettings,
        measured: Mapping[str, MeasuredModes] | None = None,
        loosened: Mapping[str, float] | None = None,
    ) -> FitProblem:
        """The fit of a hypothesis, prepared.

        Parameters
        ----------
        hypothesis : Hypothesis
        fit : FitSettings
        measured : mapping of configuration to MeasuredModes, optional
            In place of the case's own.
        loosened : mapping of parameter to float, optional
            By what the tolerances of some parameters are multiplied.
        """
        rig = self.rig_of(hypothesis)
        changed = dict(rig.parameters)
        for name, factor in (loosened or {}).items():
            changed[name] = replace(changed[name], tolerance=changed[name].tolerance * factor)
        key = hypothesis.effects
        if key not in self.families:
            self.families[key] = prepare(rig, self.measured, self.families.get(key[:-1]))
        return FitProblem(
            replace(rig, parameters=changed), measured or self.measured, fit, self.families[key]
        )


@dataclass(frozen=True)
class Fitted:
    """A hypothesis at its optimum.

    Attributes
    ----------
    hypothesis : Hypothesis
    values : dict of str to float
        All fitted parameters.
    std : dict of str to float
    objective : float
        -2 log posterior, up to a constant common to all hypotheses of the same data.
    evidence : float
        -2 log evidence (Laplace), up to the same constant.
    costs, inlier : ndarray, (R,)
        Sum of squares and inlier probability of each measured mode; infinite where it has no partner.
    counts : ndarray, (R,)
    prior_cost : float
        Sum of squares of the shifts of all parameters with a tolerance.
    missed : int
        Model modes that the test should have shown and did not.
    volume : float
        What the freedom of near modes to mix costs, as -2 log: see `mixing_volume`.
    alone : ndarray, (R,)
        Squared distance of each measured mode's frequency from the nearest model mode that has no partner, in
        standard uncertainties: what a mode without partner costs at least.
    """

    hypothesis: Hypothesis
    values: dict[str, float]
    std: dict[str, float]
    objective: float
    evidence: float
    costs: NDArray[np.float64]
    inlier: NDArray[np.float64]
    counts: NDArray[np.float64]
    prior_cost: float
    prior_count: int
    missed: int
    volume: float
    alone: NDArray[np.float64]

    @property
    def explained(self) -> NDArray[np.bool_]:
        """Which measured modes the model explains."""
        return np.isfinite(self.costs) & (self.inlier > 0.5)


def holds(fitted: Fitted) -> bool:
    """True where a model explains all modes but one (which may be spurious) about as well as data can tell."""
    return int(np.sum(~fitted.explained)) <= 1 and near(fitted)


def near(fitted: Fitted) -> bool:
    """True where a model comes about as near as data can tell to the modes that it explains."""
    squares = float(np.sum(fitted.costs[fitted.explained])) + fitted.prior_cost
    return squares < _HOLDS * float(np.sum(fitted.counts))


def fit_null(
    case: Case, hypothesis: Hypothesis, fit: FitSettings, start: Mapping[str, float] | None
) -> Fitted:
    """Fit of a base model, over the whole grid of starts."""
    problem = case.problem(hypothesis, fit)
    if not any(e.has_shapes for e in problem.evidence):
        problem = case.problem(hypothesis, finer_grid(fit))
    found = search(problem, start)
    if np.any(found.inlier < 0.5) and np.any(found.inlier > 0.5):
        found = min((found, settle(problem, found.x)), key=lambda o: o.objective)
    if np.sum(found.inlier < 0.5) > 1:
        found = min((found, *keeping_one(problem, found.inlier < 0.5)), key=lambda o: o.objective)
    return judge(case, problem, hypothesis, found)


def refit(case: Case, hypothesis: Hypothesis, fit: FitSettings, start: Mapping[str, float]) -> Fitted:
    """Fit from one starting point."""
    problem = case.problem(hypothesis, fit)
    return judge(case, problem, hypothesis, straight(problem, problem.space.point(start)))


def follow(case: Case, fitted: Fitted, fit: FitSettings) -> Fitted:
    """The same hypothesis at another noise level; straight from its optimum unless modes are lost thereby."""
    problem = case.problem(fitted.hypothesis, fit)
    found = honest(problem, refine(problem, problem.space.point(fitted.values)))
    if np.any((found.inlier < 0.5) & fitted.explained):
        return refit(case, fitted.hypothesis, fit, fitted.values)
    return judge(case, problem, fitted.hypothesis, found)


@dataclass(frozen=True)
class Ground:
    """What a hypothesis is fitted on top of.

    Attributes
    ----------
    values : dict of str to float
        Optimum of the poorer model.
    objective : float
        Its -2 log posterior.
    latent : float
        Its latent-shape objective at the end of the annealing; infinite where the model holds: then all modes
        are where they belong, the way to any optimum is short, and nothing has to be annealed.
    unexplained : tuple of (str, float)
        Configuration and frequency, Hz, of the measured modes that it does not have.
    annealed : dict of str to float
        Where the annealing ended: values that no mode was given up for, damping left aside. Empty where
        nothing was annealed.
    undamped : dict of str to float
        Optimum with the damping ratios left out, where modes are unexplained: those whose damping alone is wrong have
        their frequencies there. Empty where none are.
    """

    values: dict[str, float]
    objective: float
    latent: float
    unexplained: tuple[tuple[str, float], ...]
    annealed: dict[str, float]
    undamped: dict[str, float]

    @property
    def lost(self) -> bool:
        """True where it leaves measured modes unexplained."""
        return bool(self.unexplained)


def ground(case: Case, base: Fitted, fit: FitSettings) -> Ground:
    """Prepare a base model for the hypotheses on top of it."""
    every = [(c, float(f)) for c, m in case.measured.items() for f in m.frequency_hz]
    lost = tuple(at for at, there in zip(every, base.explained, strict=True) if not there)
    undamped = _undamped(case, base, fit) if lost else {}
    if holds(base):
        return Ground(base.values, base.objective, np.inf, lost, {}, undamped)
    problem = case.problem(base.hypothesis, fit)
    x = problem.space.point(base.values)
    nominal = np.where(problem.space.has_prior, 0.0, x)
    starts = (x, nominal, problem.space.point())
    best = min((descend_rungs(problem, start) for start in starts), key=lambda o: o.objective)
    return Ground(base.values, base.objective, best.objective, lost, problem.space.named(best.x), undamped)


def _undamped(case: Case, base: Fitted, fit: FitSettings) -> dict[str, float]:
    problem = case.problem(base.hypothesis, fit.model_copy(update={"damping": False}))
    found = settle(problem, problem.space.point(base.values))
    if np.any(found.inlier < 0.5):
        # what only the lost modes know may be anywhere: a mesh that no other mode strains
        found = min((found, search(problem, base.values)), key=lambda o: o.objective)
    return {**base.values, **problem.space.named(found.x), **_damping_values(problem, base)}


def _damping_values(problem: FitProblem, base: Fitted) -> dict[str, float]:
    names = zip(problem.space.names, problem.damping_only, strict=True)
    return {n: base.values[n] for n, damping in names if damping and n in base.values}


def fit_hypothesis(case: Case, hypothesis: Hypothesis, fit: FitSettings, base: Ground) -> Fitted:
    """Fit of a hypothesis from the base model's optimum and from visible sizes of what it adds.

    Parameters
    ----------
    case : Case
    hypothesis : Hypothesis
    fit : FitSettings
    base : Ground
        The poorer model.
    """
    problem = case.problem(hypothesis, fit)
    space = problem.space
    added = [e for e in extras(case.rig, hypothesis, case.library) if e.name in space.names]
    new = [e for e in added if e.name not in base.values]
    last = hypothesis.labels[-1]
    # a parameter out of tolerance is in the base already, at the value that its tolerance allowed
    moved = new or [e for e in added if e.name == last.partition("@")[2]]
    dynamic = not all(problem.damping_only[space.names.index(e.name)] for e in added)
    candidates: list[Optimum] = []
    if dynamic and np.isfinite(base.latent):
        starts = []
        for point in starting_points(moved):
            # from the nominal values: those of a failing base model are bent by what it is missing
            start = np.where(space.has_prior, 0.0, space.point({**base.values, **point}))
            starts.append(descend_rungs(problem, start))
        # a start is worth following only where the effect mends something on the way
        promising = [o for o in starts if o.objective < base.latent - _PROMISE]
        candidates += [straight(problem, x) for x in best_distinct(promising, 2)]
    if base.lost:
        if not dynamic:
            candidates += [settle(problem, x) for x in scanned(problem, base.undamped, moved)]
        # strong gyroscopic coupling moves frequencies too
        candidates += [settle(problem, x) for x in scanned(problem, base.values, moved)]
        if base.annealed:
            candidates += [settle(problem, x) for x in scanned(problem, base.annealed, moved, 1)]
    rig = case.rig_of(hypothesis)
    turned = any(rig.parameters[e.name].unit == "deg" for e in moved)
    if base.lost and dynamic and (turned or not np.isfinite(base.latent)):
        widened = [settle(problem, space.point({**base.values, **p})) for p in _one_sided_points(moved)]
        candidates += [*widened, *(insisting(problem, o.x) for o in widened if np.any(o.inlier < 0.5))]
    if new and base.lost:
        tuned = tuned_sizes(rig, moved, base.values, base.unexplained)
        candidates += [settle(problem, x) for x in likeliest(problem, base.values, moved, tuned)]
    if dynamic and not any(e.has_shapes for e in problem.evidence):
        for values in searched_starts(rig, last, case.measured, fit, base.values):
            candidates.append(refine(problem, space.point(values)))
    if not new:
        candidates.append(refine(problem, space.point(base.values)))
    elif not candidates or min(c.objective for c in candidates) > base.objective - _CLEAR_GAIN:
        near = [
            _near_null(problem, {**base.values, **point}, moved, base.objective)
            for point in _null_corners(moved, space)
        ]
        if len(near) > 1:
            near = best_distinct([first_steps(problem, x) for x in near], 2)
        candidates += [refine(problem, x) for x in near]
    best = min((honest(problem, o) for o in candidates), key=lambda o: o.objective)
    if best.objective < base.objective - _CLEAR_GAIN and np.any(best.inlier < 0.5):
        best = min((best, honest(problem, insisting(problem, best.x))), key=lambda o: o.objective)
    return judge(case, problem, hypothesis, best)


def _one_sided_points(moved: Sequence[Extra]) -> list[dict[str, float]]:
    """Sizes of effects of one sign, small shares of clearly visible ones.

    Where a spring is stiffer one way, the base model has made it stiffer both ways: no scan at its values shows
    what a fit of all parameters does.
    """
    sized = [e for e in moved if e.scale > 0 and e.one_sided]
    return [
        {**point, **{e.name: e.null + share * (point[e.name] - e.null) for e in sized}}
        for point in starting_points(moved)
        for share in _SHARES
        if sized
    ]


def _null_corners(moved: Sequence[Extra], space: Space) -> list[dict[str, float]]:
    """Visible sizes of what has a null; angles and quantities without one at all their starts."""
    linear = [space.coordinates[space.names.index(e.name)].kind == "linear" and e.scale > 0 for e in moved]
    axes = [(e.starts[0],) if flat else e.starts for e, flat in zip(moved, linear, strict=True)]
    return [dict(zip((e.name for e in moved), v, strict=True)) for v in product(*axes)]


def _near_null(
    problem: FitProblem, values: Mapping[str, float], moved: Sequence[Extra], base_objective: float
) -> NDArray[np.float64]:
    """The point with sizes drawn towards null until no mode is lost: a lost mode no longer pulls."""
    space, mixture = problem.space, problem.mixture()
    linear = [
        e for e in moved if e.scale > 0 and space.coordinates[space.names.index(e.name)].kind == "linear"
    ]
    share = 0.1
    x = space.point(values)
    if not linear:
        return x
    pairs = problem.assignments(space.point({**values, **{e.name: e.null for e in linear}}))
    objective = problem.exact(pairs)
    for _ in range(8):
        small = {e.name: e.null + share * (values[e.name] - e.null) for e in linear}
        x = space.point({**values, **small})
        cost = float(np.sum(mixture.robust(objective.costs(x))) + np.sum(x[space.has_prior] ** 2))
        if cost < base_objective + _NEAR:
            break
        share *= 0.2
    return x


def judge(case: Case, problem: FitProblem, hypothesis: Hypothesis, found: Optimum) -> Fitted:
    """Evidence and standard deviations at an optimum."""
    space = problem.space
    covariance = posterior_covariance(problem, found, 1.0)
    std = np.sqrt(np.diag(covariance)) * np.abs(space.slopes(found.x))
    missed = missed_modes(problem, found.x)
    added = extras(case.rig, hypothesis, case.library)
    evidence = found.objective + occam(problem, found, covariance, added)
    evidence += -2 * np.log(case.settings.missed_mode) * missed
    volume = mixing_volume(problem, found)
    evidence += volume
    prior = space.has_prior
    return Fitted(
        hypothesis=hypothesis,
        values=space.named(found.x),
        std={n: float(s) for n, s in zip(space.names, std, strict=True)},
        objective=found.objective,
        evidence=float(evidence),
        costs=found.costs,
        inlier=found.inlier,
        counts=problem.counts,
        prior_cost=float(np.sum(found.x[prior] ** 2)),
        prior_count=int(np.sum(prior)),
        missed=missed,
        volume=volume,
        alone=lonely_cost(problem, found.x),
    )
