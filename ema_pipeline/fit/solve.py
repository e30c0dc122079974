"""The search for the most probable parameters: annealed latent shapes first, paired eigen-residuals last.

The posterior is a product over measured modes of a mixture (a mode of the rig, or an outlier) and of the Gaussian
priors that the tolerances state; free parameters have no prior but their bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.pairing import assign, close_groups, shape_agreement
from ema_pipeline.correlate.residuals import Modes, observable_modes
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.fit.evidence import Dataset, dataset
from ema_pipeline.fit.exact import ExactObjective
from ema_pipeline.fit.latent import LatentObjective
from ema_pipeline.fit.matrices import MatrixFamily
from ema_pipeline.fit.remembered import Remembered
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.space import Space, make_space
from ema_pipeline.rigs.types import Rig

Progress = Callable[[float, str], None]

_UNSEEN = 0.02


class Objective(Protocol):
    """Costs of the measured modes and their Gauss-Newton terms."""

    def costs(self, x: NDArray[np.float64]) -> NDArray[np.float64]: ...

    def normal_equations(
        self, x: NDArray[np.float64], weight: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...


@dataclass(frozen=True)
class Mixture:
    """Robust cost of a mode: -2 log((1-π)·exp(-c/2) + π·exp(-c_outlier/2)), zero for a perfect fit.

    Attributes
    ----------
    outlier_cost : ndarray, (R,)
    prior : float
        π.
    scale : float
        Misfit scale that divides all residuals.
    """

    outlier_cost: NDArray[np.float64]
    prior: float
    scale: float = 1.0

    def trusting(self) -> Mixture:
        """The same with no mode taken for an outlier."""
        return replace(self, outlier_cost=np.full_like(self.outlier_cost, np.inf))

    def robust(self, cost: NDArray[np.float64]) -> NDArray[np.float64]:
        """Robust cost of each mode."""
        return -2 * np.logaddexp(-0.5 * cost / self.scale**2, self._rival())

    def inlier(self, cost: NDArray[np.float64]) -> NDArray[np.float64]:
        """Probability that each mode is a mode of the rig."""
        good = -0.5 * cost / self.scale**2
        return np.asarray(np.exp(good - np.logaddexp(good, self._rival())))

    def _rival(self) -> NDArray[np.float64]:
        return -0.5 * self.outlier_cost + np.log(self.prior / (1 - self.prior))


@dataclass(frozen=True)
class Optimum:
    """Where a search ended.

    Attributes
    ----------
    x : ndarray, (P,)
    objective : float
        -2 log posterior up to a constant that does not depend on the model.
    costs, inlier : ndarray, (R,)
        Cost and inlier probability of each measured mode, configurations one after the other.
    stop_reason : str
    """

    x: NDArray[np.float64]
    objective: float
    costs: NDArray[np.float64]
    inlier: NDArray[np.float64]
    stop_reason: str


class FitProblem:
    """Rig, data and settings, prepared once: the parameter space, matrix families and weighted modes.

    Parameters
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
    settings : FitSettings
    families : mapping of configuration to MatrixFamily, optional
        Matrices prepared before for a rig that differs from this one in tolerances and bounds only.

    Raises
    ------
    EmaError
        If there are no modes, or a configuration or DOF is unknown to the rig.
    """

    def __init__(
        self,
        rig: Rig,
        measured: Mapping[str, MeasuredModes],
        settings: FitSettings,
        families: Mapping[str, MatrixFamily] | None = None,
    ) -> None:
        self.rig = rig
        self.settings = settings
        used = {c: m for c, m in measured.items() if len(m)}
        if not used:
            raise EmaError("no measured modes to fit: identify modes first, or widen the analysed band")
        everything = make_space(list(rig.parameters.values()))
        known = families or prepare(rig, used)
        over = {c: known[c].over(everything) for c in used}
        relevant = np.any([f.relevant for f in over.values()], axis=0)
        if not any(np.any(np.isfinite(m.damping_ratio)) for m in used.values()) or not settings.damping:
            # Nothing speaks about damping: such parameters stay at their nominal values.
            relevant &= np.any([_undamped_relevance(f) for f in over.values()], axis=0)
        self.space = Space(tuple(c for c, r in zip(everything.coordinates, relevant, strict=True) if r))
        self.irrelevant = tuple(
            c.parameter for c, r in zip(everything.coordinates, relevant, strict=True) if not r
        )
        self.evidence: list[Dataset] = [
            dataset(m, over[c].over(self.space), settings) for c, m in used.items()
        ]
        undamped = np.any([_undamped_relevance(e.family) for e in self.evidence], axis=0)
        self.damping_only = ~np.asarray(undamped, dtype=bool)
        self.counts = np.concatenate([e.counts for e in self.evidence])
        self._paired = Remembered(self._pair)

    def mixture(self, scale: float = 1.0) -> Mixture:
        """Robust cost with all standard uncertainties multiplied by `scale`."""
        cost = np.concatenate([e.outlier_cost(scale) for e in self.evidence])
        return Mixture(cost, self.settings.outlier_prior, scale)

    def assignments(self, x: NDArray[np.float64]) -> list[NDArray[np.int64]]:
        """Model mode of each measured mode at a point, -1 where none, per configuration."""
        return self._paired(x)[1]

    def modes(self, x: NDArray[np.float64]) -> list[Modes]:
        """Modes of the model at a point, per configuration."""
        return self._paired(x)[0]

    def model_omega(self, e: Dataset, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Frequencies of the model of one configuration at a point, rad/s, (n,)."""
        return np.asarray(observable_modes(e.family.at(x[None])).omega[0])

    def _pair(self, x: NDArray[np.float64]) -> tuple[list[Modes], list[NDArray[np.int64]]]:
        modes = [observable_modes(e.family.at(x[None])) for e in self.evidence]
        pairs = [_assignment(e, m, self.settings) for e, m in zip(self.evidence, modes, strict=True)]
        return modes, pairs

    def exact(self, pairs: Sequence[NDArray[np.int64]], alone: float = np.inf) -> ExactObjective:
        """Eigen-residual objective with fixed pairs; `alone` is the cost of a mode without partner."""
        return ExactObjective(self.evidence, pairs, self.settings.mode_mixing, alone)


def prepare(
    rig: Rig, measured: Mapping[str, MeasuredModes], poorer: Mapping[str, MatrixFamily] | None = None
) -> dict[str, MatrixFamily]:
    """Matrix families of all configurations that have modes.

    Parameters
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
    poorer : mapping of configuration to MatrixFamily, optional
        Of a rig with fewer parameters: saves most of the work.

    Raises
    ------
    EmaError
        If a configuration or DOF is unknown to the rig.
    """
    space = make_space(list(rig.parameters.values()))
    made = {}
    for c, m in measured.items():
        if not len(m):
            continue
        if c not in rig.configurations:
            raise EmaError(
                f"rig '{rig.name}' has no configuration '{c}'{did_you_mean(c, rig.configurations)}"
            )
        assembly = rig.assembly(c)
        for dof in m.dofs:
            if not assembly.has_dof(dof.point):
                raise EmaError(f"{c}: rig '{rig.name}' has no dof '{dof.point}'; correct 'dof' in test.toml")
        made[c] = MatrixFamily(rig, c, space, (poorer or {}).get(c))
    return made


def descend(
    objective: Objective,
    space: Space,
    start: NDArray[np.float64],
    mixture: Mixture,
    iterations: int,
    held: NDArray[np.bool_] | None = None,
    convergence: float = 1e-7,
) -> Optimum:
    """Levenberg-Marquardt on the robust posterior (iteratively reweighted by the inlier probabilities).

    Parameters
    ----------
    objective : Objective
    space : Space
    start : ndarray, (P,)
    mixture : Mixture
    iterations : int
    held : ndarray of bool, (P,), optional
        Coordinates that stay at their start.
    convergence : float
        The search ends when a step gains less than this share of the objective (plus one).
    """
    prior = space.has_prior.astype(float)
    moving = np.ones(start.size, dtype=bool) if held is None else ~held

    def value(costs: NDArray[np.float64], x: NDArray[np.float64]) -> float:
        return float(np.sum(mixture.robust(costs)) + np.sum(prior * x**2))

    x, costs = start, objective.costs(start)
    best, damping, reason = value(costs, x), 1e-3, f"stopped after {iterations} steps"
    for _ in range(iterations):
        weight = mixture.inlier(costs) / mixture.scale**2
        normal, gradient = objective.normal_equations(x, weight)
        normal = normal + np.diag(prior)
        gradient = gradient + prior * x
        # a coordinate that its bound holds back takes no part
        stuck = ((x <= space.low) & (gradient > 0)) | ((x >= space.high) & (gradient < 0))
        free = moving & ~stuck
        if not np.any(free):
            reason = "no parameter left to move"
            break
        improved, gain = False, 0.0
        for _ in range(8):
            a = normal[np.ix_(free, free)]
            lift = damping * (np.diag(a) + 1e-9 * np.trace(a) + 1e-12)
            step = np.zeros(x.size)
            step[free] = -np.linalg.solve(a + np.diag(lift), gradient[free])
            candidate = space.retract(x, step)
            try:
                candidate_costs = objective.costs(candidate)
            except np.linalg.LinAlgError:  # a step so far that no mass matrix is left: a shorter one may do
                damping = min(damping * 10, 1e9)
                continue
            after = value(candidate_costs, candidate)
            if np.isfinite(after) and after < best:
                improved, gain = True, best - after
                x, costs, best = candidate, candidate_costs, after
                damping = max(damping / 10, 1e-9)
                break
            damping = min(damping * 10, 1e9)
        if not improved or gain < convergence * (1 + abs(best)):
            reason = "converged: no step improves the fit"
            break
    return Optimum(x, best, costs, mixture.inlier(costs), reason)


def anneal(problem: FitProblem, start: NDArray[np.float64], skip: int = 0) -> NDArray[np.float64]:
    """Follow the optimum of the latent-shape objective from a loose to the measured eigenvalue error."""
    x = start
    mixture = problem.mixture()
    for tau in ladder(problem)[skip:]:
        x = descend(LatentObjective(problem.evidence, tau), problem.space, x, mixture, 6).x
    return x


def ladder(problem: FitProblem) -> NDArray[np.float64]:
    """Eigenvalue errors of the annealing, from `annealing_start` to the best mode's own."""
    least = min(float(np.min(2 * e.relative_std)) for e in problem.evidence)
    settings = problem.settings
    return np.geomspace(max(settings.annealing_start, least), least, settings.annealing_rungs)


def refine(problem: FitProblem, start: NDArray[np.float64], scale: float = 1.0) -> Optimum:
    """Pair at the fitted parameters, refine on eigen-residuals, and pair again until nothing changes."""
    x, best = start, None
    mixture = problem.mixture(scale)
    for _ in range(4):
        pairs = problem.assignments(x)
        if best is None and np.any(problem.damping_only):
            # The latent shapes say nothing of damping: far from it every mode would look like an outlier.
            held = ~problem.damping_only
            matched = problem.exact(pairs, alone=0.0)
            x = descend(matched, problem.space, x, mixture.trusting(), 6, held).x
        found = descend(
            problem.exact(pairs), problem.space, x, mixture, problem.settings.iterations, None,
            problem.settings.convergence,
        )  # fmt: skip
        if best is not None and found.objective >= best.objective - 1e-9:
            break
        best, x = found, found.x
        if all(np.array_equal(p, q) for p, q in zip(pairs, problem.assignments(x), strict=True)):
            break
    assert best is not None
    return best


def search(
    problem: FitProblem, start: Mapping[str, float] | None, progress: Progress | None = None
) -> Optimum:
    """Most probable parameters over a grid of starts of the free parameters.

    The whole annealing from the nominal values finds the optimum nearly always. It leans towards soft free springs
    (a loose dynamic residual prefers them), so every point of the grid also competes further down the ladder,
    and
    the best of these are followed to its end. With `start` given (the fit of a poorer model, say) that point
    is
    refined as well, so that a richer model never fits worse than the poorer one.
    """
    tell = progress or (lambda share, text: None)
    settings, space = problem.settings, problem.space
    rungs = ladder(problem)
    candidates = [refine(problem, anneal(problem, space.point()))]
    if np.any(~space.has_prior):
        middle = int(np.argmin(np.abs(np.log(rungs / settings.screening_error))))
        lower, mixture = LatentObjective(problem.evidence, float(rungs[middle])), problem.mixture()
        grid = space.starts(settings.starts_per_decade)
        screened = []
        for i, x in enumerate(grid):
            found = descend(lower, space, x, mixture, 4)
            screened.append((found.objective, i, found.x))
            tell(0.05 + 0.4 * (i + 1) / len(grid), "screening starting values")
        screened.sort(key=lambda s: (s[0], s[1]))
        chosen = _distinct([s[2] for s in screened], settings.starts_refined)
        for i, x in enumerate(chosen):
            candidates.append(refine(problem, anneal(problem, x, skip=middle + 1)))
            tell(0.45 + 0.35 * (i + 1) / len(chosen), "annealing")
    if start is not None:
        candidates.append(refine(problem, space.point(start)))
    return min(candidates, key=lambda c: c.objective)


def _distinct(points: list[NDArray[np.float64]], count: int) -> list[NDArray[np.float64]]:
    """The first `count` points that differ."""
    out: list[NDArray[np.float64]] = []
    for p in points:
        if all(np.max(np.abs(p - q)) > 0.05 for q in out):
            out.append(p)
        if len(out) == count:
            break
    return out


def _assignment(e: Dataset, modes: Modes, settings: FitSettings) -> NDArray[np.int64]:
    omega, shapes = modes.omega[0], (e.rows @ modes.shapes[0]).T
    model_hz = omega / (2 * np.pi)
    groups = close_groups(model_hz, settings.pairing.group_width)
    single, grouped = shape_agreement(e.measured, np.asarray(shapes, dtype=complex), groups)
    elastic = model_hz > 1e-3
    if e.has_shapes:
        # A mode that no sensor sees cannot have been measured; mixed with its neighbours it would fit anything.
        seen = np.linalg.norm(shapes, axis=1)
        elastic &= seen > _UNSEEN * float(np.max(seen, initial=0.0))
    distance = np.where(
        elastic, np.abs(np.log(e.measured.frequency_hz[:, None] / np.where(elastic, model_hz, 1.0))), np.inf
    )
    chosen = assign(distance, grouped, single, settings.pairing)
    pairs = np.full(e.omega.size, -1, dtype=np.int64)
    for r, k in chosen.items():
        pairs[r] = k
    # Modes that coincide have no order of their own: the lower measured one takes the lower model mode.
    near = close_groups(model_hz, settings.mode_mixing)
    for g in np.unique(near):
        members = [r for r in range(pairs.size) if pairs[r] >= 0 and near[pairs[r]] == g]
        for r, k in zip(sorted(members), sorted(int(pairs[r]) for r in members), strict=True):
            pairs[r] = k
    return pairs


def _undamped_relevance(family: MatrixFamily) -> NDArray[np.bool_]:
    n2 = family.size**2
    used = np.any(family.coefficients[1 : 1 + len(family.relevant), : 2 * n2] != 0, axis=1)
    for (i, j), product in zip(family.pairs, family.coefficients[1 + len(used) :], strict=True):
        if np.any(product[: 2 * n2] != 0):
            used[[i, j]] = True
    return np.asarray(used)
