"""The measurement that would tell two explanations apart: predicted difference over uncertainty, for every option.

Options are sensors at places that carry none, a known mass put on a body, a body clamped, and configurations that
were not measured. Both explanations predict what each would show; the difference counts in units of what the
measurement and the explanation's own parameters leave open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.correlate.residuals import Matrices, modal_basis
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.hypotheses import make_rig
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.map_fit import posterior_covariance
from ema_pipeline.fit.matrices import MatrixFamily
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, Optimum
from ema_pipeline.mechanics.system import LinearSystem

_STEP = 1e-3
_ADDED_SHARE = 0.2
_DEFAULT_BAND = (1.0, 2000.0)

Predict = Callable[[Matrices], NDArray[np.float64]]


@dataclass(frozen=True)
class Option:
    """A measurement that could be made, and the separation in standard deviations that it promises."""

    text: str
    separation: float


@dataclass(frozen=True)
class _Side:
    """One explanation: its matrices around the optimum and the spread of its parameters."""

    problem: FitProblem
    x: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def points(self) -> NDArray[np.float64]:
        spread = np.sqrt(np.diag(self.covariance))
        steps = np.diag(np.maximum(_STEP * spread, 1e-7))
        return np.vstack([self.x[None], self.x + steps, self.x - steps])

    def slopes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Jacobian over the coordinates in standard deviations, (P, n), of predictions at `points`."""
        p = self.x.size
        spread = np.sqrt(np.diag(self.covariance))
        steps = np.maximum(_STEP * spread, 1e-7)
        return np.asarray((values[1 : p + 1] - values[p + 1 :]) / (2 * steps[:, None]))


def best_measurement(case: Case, a: Fitted, b: Fitted, fit: FitSettings) -> Option | None:
    """The option that separates two explanations best; None where none is known."""
    found = options(case, a, b, fit)
    return max(found, key=lambda o: o.separation) if found else None


def options(case: Case, a: Fitted, b: Fitted, fit: FitSettings) -> list[Option]:
    """All options with their separations, in no order."""
    sides = [_side(case, f, fit) for f in (a, b)]
    result = []
    for e, other in zip(sides[0].problem.evidence, sides[1].problem.evidence, strict=True):
        result += _sensors(e, other, sides, fit)
        result += _masses(e, other, sides, fit)
        result += _clamps(e, other, sides, fit)
    result += _configurations(case, sides, fit)
    return result


def _side(case: Case, fitted: Fitted, fit: FitSettings) -> _Side:
    rig = make_rig(case.rig, fitted.hypothesis, case.library, case.settings.parameter_range)
    problem = FitProblem(rig, case.measured, fit)
    x = problem.space.point(fitted.values)
    optimum = Optimum(x, fitted.objective, fitted.costs, fitted.inlier, "")
    return _Side(problem, x, posterior_covariance(problem, optimum, 1.0))


def _separation(
    sides: list[_Side],
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    sigma: NDArray[np.float64] | float,
) -> float:
    """√(dᵀ V⁻¹ d) of two predictions, V of the measurement and of the first explanation's parameters."""
    if first.shape[1] == 0 or first.shape[1] != second.shape[1]:
        return 0.0
    d = first[0] - second[0]
    if d.size == 0 or not np.all(np.isfinite(d)):
        return 0.0
    slopes = sides[0].slopes(first)
    v = slopes.T @ sides[0].covariance @ slopes + np.eye(d.size) * np.asarray(sigma) ** 2
    return float(np.sqrt(max(d @ np.linalg.solve(v, d), 0.0)))


def _band(e: Dataset) -> tuple[float, float]:
    return e.measured.band_hz or (
        0.5 * float(e.measured.frequency_hz[0]),
        1.2 * float(e.measured.frequency_hz[-1]),
    )


def _sensors(e: Dataset, other: Dataset, sides: list[_Side], fit: FitSettings) -> list[Option]:
    """A further sensor at every coordinate that carries none."""
    if not e.has_shapes:
        return []
    instrumented = {d.point for d in e.measured.dofs}
    free = [d for d in e.family.system.dofs if d not in instrumented and not _seen_otherwise(e, d)]
    free = [d for d in free if d in other.family.system.dofs]
    result = []
    pairs = [
        next(p for p, k in zip(s.problem.assignments(s.x), s.problem.evidence, strict=True)
             if k.measured.configuration == e.measured.configuration)
        for s in sides
    ]  # fmt: skip
    common = np.flatnonzero((pairs[0] >= 0) & (pairs[1] >= 0))
    if common.size == 0:
        return []
    for dof in free:
        predicted = []
        for s, k, p in zip(sides, (e, other), pairs, strict=True):
            basis = modal_basis(k.family.at(s.points))
            at = k.family.system.dofs.index(dof)
            modal = basis.shapes[:, :, p[common]]
            seen = k.rows @ modal
            measured = e.shapes[common].real.T[None]
            scale = np.sum(seen * measured, axis=1) / np.maximum(np.sum(seen**2, axis=1), 1e-30)
            predicted.append(modal[:, at, :] * scale)
        sigma = max(fit.shape_floor, 0.01)
        z = _separation(sides, predicted[0], predicted[1], sigma)
        result.append(Option(f"a sensor at {dof} ({e.measured.configuration})", z))
    return result


def _seen_otherwise(e: Dataset, dof: str) -> bool:
    """True where sensors in other directions of the same body read this coordinate too (a planet's ζ by x)."""
    row = np.zeros(len(e.family.system.dofs))
    row[e.family.system.dofs.index(dof)] = 1.0
    left = row - np.linalg.lstsq(e.rows.T, row, rcond=None)[0] @ e.rows
    return bool(np.linalg.norm(left) < 1e-6)


def _frequencies(
    m: Matrices, band: tuple[float, float], like: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Logarithms of frequencies inside the band, (B, n); matched to `like` where given."""
    f = np.sqrt(np.maximum(modal_basis(m).eigenvalues, 1e-6)) / (2 * np.pi)
    logs = np.log(f)
    if like is None:
        inside = (f[0] > max(band[0], 1.0)) & (f[0] < band[1])
        return np.asarray(logs[:, inside])
    _, columns = linear_sum_assignment(np.abs(like[:, None] - logs[0][None, :]))
    return np.asarray(logs[:, columns])


def _by_frequency(
    sides: list[_Side],
    families: tuple[MatrixFamily, MatrixFamily],
    band: tuple[float, float],
    change: Callable[[Matrices, LinearSystem], Matrices],
    sigma: float,
) -> float:
    first = _frequencies(change(families[0].at(sides[0].points), families[0].system), band, None)
    second = _frequencies(change(families[1].at(sides[1].points), families[1].system), band, first[0])
    return _separation(sides, first, second, sigma)


def _masses(e: Dataset, other: Dataset, sides: list[_Side], fit: FitSettings) -> list[Option]:
    """A known mass on each body."""
    result = []
    sigma = max(fit.frequency_floor, 1e-4)
    for body in _bodies(e):
        index = [i for i, d in enumerate(e.family.system.dofs) if _body(d) == body and not d.endswith(".u")]
        if not index:
            continue
        # round to one digit: a mass that a workshop has
        share = _ADDED_SHARE * float(e.family.system.mass[index[0], index[0]])
        mass = float(f"{share:.0e}")

        def loaded(m: Matrices, system: LinearSystem, body: str = body, mass: float = mass) -> Matrices:
            at = [i for i, d in enumerate(system.dofs) if _body(d) == body and not d.endswith(".u")]
            heavier = m.mass.copy()
            for i in at:
                heavier[:, i, i] += mass
            return replace(m, mass=heavier)

        z = _by_frequency(sides, (e.family, other.family), _band(e), loaded, sigma)
        result.append(
            Option(f"a known mass of {mass:g} kg at the centre of {body} ({e.measured.configuration})", z)
        )
    return result


def _clamps(e: Dataset, other: Dataset, sides: list[_Side], fit: FitSettings) -> list[Option]:
    """Each body held to ground."""
    result = []
    sigma = max(fit.frequency_floor, 1e-4)
    for body in _bodies(e):
        if body.startswith("planet"):
            continue

        def held(m: Matrices, system: LinearSystem, body: str = body) -> Matrices:
            keep = np.array([i for i, d in enumerate(system.dofs) if _body(d) != body])
            grid = np.ix_(np.arange(len(m.mass)), keep, keep)
            return replace(m, mass=m.mass[grid], stiffness=m.stiffness[grid])

        if len(e.family.system.dofs) <= 3:
            continue
        z = _by_frequency(sides, (e.family, other.family), _band(e), held, sigma)
        result.append(Option(f"a test with the {body} clamped ({e.measured.configuration})", z))
    return result


def _configurations(case: Case, sides: list[_Side], fit: FitSettings) -> list[Option]:
    """Configurations of the rig that were not measured."""
    result = []
    measured = {e.measured.configuration for e in sides[0].problem.evidence}
    for c in case.rig.configurations:
        if c in measured:
            continue
        families = tuple(MatrixFamily(s.problem.rig, c, s.problem.space) for s in sides)
        band = _band(sides[0].problem.evidence[0]) if sides[0].problem.evidence else _DEFAULT_BAND
        z = _by_frequency(
            sides, (families[0], families[1]), band, lambda m, system: m, max(fit.frequency_floor, 1e-4)
        )
        result.append(Option(f"a test in configuration {c}", z))
    return result


def _bodies(e: Dataset) -> list[str]:
    return [b for b in dict.fromkeys(_body(d) for d in e.family.system.dofs) if not b.endswith("_support")]


def _body(dof: str) -> str:
    return dof.rpartition(".")[0]
