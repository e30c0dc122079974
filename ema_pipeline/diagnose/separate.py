"""The measurement that would tell two explanations apart: predicted difference over uncertainty, for every option.

Options are sensors and impact points at places that have none, a known mass put on a body, a body clamped,
configurations that were not measured, and harder hits. Both explanations predict what each would show; the
difference counts in units of what the measurement and the explanation's own parameters leave open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.correlate.residuals import Matrices, modal_basis
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.fit.evidence import Dataset
from ema_pipeline.fit.map_fit import posterior_covariance
from ema_pipeline.fit.matrices import MatrixFamily
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, Optimum
from ema_pipeline.mechanics.system import LinearSystem

_STEP = 1e-3
_ADDED_SHARE = 0.2
_DEFAULT_BAND = (1.0, 2000.0)
_LEAST_SHAPE = 0.01
_LEAST_FREQUENCY = 1e-4
_HIDDEN = 0.02
_HARDER = 3.0
"""Hits three times as hard: from a metal tip to a heavier hammer, still within one sensor's range."""

Change = Callable[[Matrices, LinearSystem], Matrices]


@dataclass(frozen=True)
class Option:
    """A measurement that could be made.

    Attributes
    ----------
    text : str
        What to do.
    separation : float
        Standard deviations by which two explanations would differ.
    effect : str
        What would be seen, in words; the two explanations stand as ``{first}`` and ``{second}``.
    """

    text: str
    separation: float
    effect: str = ""


@dataclass(frozen=True)
class _Side:
    """One explanation: its matrices around the optimum and the spread of its parameters."""

    problem: FitProblem
    x: NDArray[np.float64]
    covariance: NDArray[np.float64]
    costs: NDArray[np.float64]

    @property
    def steps(self) -> NDArray[np.float64]:
        spread = np.sqrt(np.diag(self.covariance))
        return np.maximum(_STEP * spread, 1e-7)

    @property
    def points(self) -> NDArray[np.float64]:
        steps = np.diag(self.steps)
        return np.vstack([self.x[None], self.x + steps, self.x - steps])

    def slopes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Jacobian, (P, n), of predictions at `points`."""
        p = self.x.size
        return np.asarray((values[1 : p + 1] - values[p + 1 :]) / (2 * self.steps[:, None]))


@dataclass(frozen=True)
class _Place:
    """One configuration under both explanations."""

    data: tuple[Dataset, Dataset]
    sides: tuple[_Side, _Side]
    fit: FitSettings

    @property
    def configuration(self) -> str:
        return self.data[0].measured.configuration

    @property
    def dofs(self) -> list[str]:
        """Coordinates that both explanations have."""
        other = set(self.data[1].family.system.dofs)
        return [d for d in self.data[0].family.system.dofs if d in other]

    @property
    def bodies(self) -> list[str]:
        return [b for b in dict.fromkeys(_body(d) for d in self.dofs) if not b.endswith("_support")]

    @property
    def band(self) -> tuple[float, float]:
        m = self.data[0].measured
        return m.band_hz or (0.5 * float(m.frequency_hz[0]), 1.2 * float(m.frequency_hz[-1]))

    @property
    def frequency_std(self) -> float:
        """Relative, of a further measurement like those made."""
        return max(self.fit.frequency_floor, _LEAST_FREQUENCY, float(np.median(self.data[0].relative_std)))

    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Model mode of each measured mode under both explanations."""
        first, second = (
            next(
                p
                for p, e in zip(s.problem.assignments(s.x), s.problem.evidence, strict=True)
                if e.measured.configuration == self.configuration
            )
            for s in self.sides
        )
        return first, second


def best_measurement(case: Case, a: Fitted, b: Fitted, fit: FitSettings) -> Option | None:
    """The option that separates two explanations best; None where none is known."""
    found = options(case, a, b, fit)
    return max(found, key=lambda o: o.separation) if found else None


def options(case: Case, a: Fitted, b: Fitted, fit: FitSettings) -> list[Option]:
    """All options with their separations, in no order."""
    sides = (_side(case, a, fit), _side(case, b, fit))
    result = []
    for data in zip(sides[0].problem.evidence, sides[1].problem.evidence, strict=True):
        place = _Place(data, sides, fit)
        result += [*_sensors(place), *_impacts(place), *_masses(place), *_clamps(place)]
    return [*result, *_configurations(case, sides, fit), *_harder(case, sides)]


def _side(case: Case, fitted: Fitted, fit: FitSettings) -> _Side:
    problem = case.problem(fitted.hypothesis, fit)
    x = problem.space.point(fitted.values)
    optimum = Optimum(x, fitted.objective, fitted.costs, fitted.inlier, "")
    return _Side(problem, x, posterior_covariance(problem, optimum, 1.0), fitted.costs)


def _separation(
    side: _Side,
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    sigma: NDArray[np.float64] | float,
) -> float:
    """√(dᵀ V⁻¹ d) of two predictions, V of the measurement and of the first explanation's parameters."""
    if first.shape[1] == 0 or first.shape[1] != second.shape[1]:
        return 0.0
    d = first[0] - second[0]
    if not np.all(np.isfinite(d)):
        return 0.0
    slopes = side.slopes(first)
    v = slopes.T @ side.covariance @ slopes + np.eye(d.size) * np.asarray(sigma) ** 2
    return float(np.sqrt(max(d @ np.linalg.solve(v, d), 0.0)))


def _sensors(place: _Place) -> list[Option]:
    """A further sensor at every coordinate that carries none."""
    e, other = place.data
    if not e.has_shapes:
        return []
    instrumented = {d.point for d in e.measured.dofs}
    free = [d for d in place.dofs if d not in instrumented and not _seen_otherwise(e, d)]
    pairs = place.pairs()
    common = np.flatnonzero((pairs[0] >= 0) & (pairs[1] >= 0))
    if common.size == 0:
        return []
    result = []
    for dof in free:
        predicted = []
        for s, k, p in zip(place.sides, (e, other), pairs, strict=True):
            basis = modal_basis(k.family.at(s.points))
            at = k.family.system.dofs.index(dof)
            modal = basis.shapes[:, :, p[common]]
            seen = k.rows @ modal
            measured = e.shapes[common].real.T[None]
            scale = np.sum(seen * measured, axis=1) / np.maximum(np.sum(seen**2, axis=1), 1e-30)
            predicted.append(modal[:, at, :] * scale)
        sigma = max(place.fit.shape_floor, _LEAST_SHAPE)
        z = _separation(place.sides[0], predicted[0], predicted[1], sigma)
        most = int(np.argmax(np.abs(predicted[0][0] - predicted[1][0])))
        f = float(e.measured.frequency_hz[common[most]])
        effect = (
            f"at {f:.1f} Hz it would read {predicted[0][0, most]:+.2f} of the largest entry with {{first}}, "
            f"{predicted[1][0, most]:+.2f} with {{second}}"
        )
        result.append(Option(f"a sensor at {dof} ({place.configuration})", z, effect))
    return result


def _seen_otherwise(e: Dataset, dof: str) -> bool:
    """True where sensors in other directions of the same body read this coordinate too (a planet's ζ by x)."""
    row = np.zeros(len(e.family.system.dofs))
    row[e.family.system.dofs.index(dof)] = 1.0
    left = row - np.linalg.lstsq(e.rows.T, row, rcond=None)[0] @ e.rows
    return bool(np.linalg.norm(left) < 1e-6)


def _impacts(place: _Place) -> list[Option]:
    """A further impact point: it shows modes that have a node at all points struck so far."""
    e, _ = place.data
    struck = [d.point for d in e.measured.references]
    if not struck:
        return []
    low, high = place.band
    pairs = place.pairs()
    hidden: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]] = []
    for s, k, p in zip(place.sides, place.data, pairs, strict=True):
        basis = modal_basis(k.family.at(s.points))
        f = np.sqrt(np.maximum(basis.eigenvalues, 1e-6)) / (2 * np.pi)
        known = np.zeros(f.shape[1], dtype=bool)
        known[p[p >= 0]] = True
        at = [k.family.system.dofs.index(d) for d in struck if d in k.family.system.dofs]
        excited = np.max(np.abs(basis.shapes[0][at]), axis=0, initial=0.0) > _HIDDEN * np.max(
            np.abs(basis.shapes[0])
        )
        unseen = np.flatnonzero(~known & ~excited & (f[0] > max(low, 1.0)) & (f[0] < high))
        hidden.append((f, basis.shapes, np.max(np.abs(basis.shapes[0]), axis=0), unseen))
    result = []
    for dof in place.dofs:
        if dof in struck:
            continue
        logs = []
        for (f, shapes, largest, unseen), k in zip(hidden, place.data, strict=True):
            row = k.family.system.dofs.index(dof)
            shown = unseen[np.abs(shapes[0][row, unseen]) > 0.1 * largest[unseen]]
            logs.append(np.log(f[:, shown]))
        count = min(logs[0].shape[1], logs[1].shape[1])
        if count == 0:
            continue
        first, second = logs[0][:, :count], logs[1][:, :count]
        z = _separation(place.sides[0], first, second, place.frequency_std)
        text = f"hits at {dof} ({place.configuration})"
        result.append(Option(text, z, _frequency_effect(first[0], second[0], "a mode not seen so far")))
    return result


def _frequency_effect(first: NDArray[np.float64], second: NDArray[np.float64], name: str) -> str:
    """The frequency that differs most, under both explanations; arguments are logarithms."""
    k = int(np.argmax(np.abs(first - second)))
    a, b = float(np.exp(first[k])), float(np.exp(second[k]))
    decimals = int(np.clip(2 - np.floor(np.log10(max(abs(a - b), 1e-6))), 0, 3))
    return f"{name} would be at {a:.{decimals}f} Hz with {{first}}, at {b:.{decimals}f} Hz with {{second}}"


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
    text: str,
    sides: tuple[_Side, _Side],
    families: tuple[MatrixFamily, MatrixFamily],
    band: tuple[float, float],
    change: Change,
    sigma: float,
) -> Option:
    """What the frequencies of a changed test would show."""
    first = _frequencies(change(families[0].at(sides[0].points), families[0].system), band, None)
    if first.shape[1] == 0:
        return Option(text, 0.0)
    second = _frequencies(change(families[1].at(sides[1].points), families[1].system), band, first[0])
    z = _separation(sides[0], first, second, sigma)
    if first.shape[1] != second.shape[1]:
        return Option(text, 0.0)
    return Option(text, z, _frequency_effect(first[0], second[0], "a mode"))


def _masses(place: _Place) -> list[Option]:
    """A known mass on each body."""
    result = []
    first = place.data[0].family.system
    for body in place.bodies:
        index = [i for i, d in enumerate(first.dofs) if _body(d) == body and not d.endswith(".u")]
        if not index:
            continue
        # round to one digit: a mass that a workshop has
        mass = float(f"{_ADDED_SHARE * float(first.mass[index[0], index[0]]):.0e}")

        def loaded(m: Matrices, system: LinearSystem, body: str = body, mass: float = mass) -> Matrices:
            at = [i for i, d in enumerate(system.dofs) if _body(d) == body and not d.endswith(".u")]
            heavier = m.mass.copy()
            for i in at:
                heavier[:, i, i] += mass
            return replace(m, mass=heavier)

        text = f"a known mass of {mass:g} kg at the centre of {body} ({place.configuration})"
        result.append(_changed(place, text, loaded))
    return result


def _clamps(place: _Place) -> list[Option]:
    """Each body held to ground."""
    if len(place.data[0].family.system.dofs) <= 3:
        return []
    result = []
    for body in place.bodies:
        if body.startswith("planet"):
            continue

        def held(m: Matrices, system: LinearSystem, body: str = body) -> Matrices:
            keep = np.array([i for i, d in enumerate(system.dofs) if _body(d) != body])
            grid = np.ix_(np.arange(len(m.mass)), keep, keep)
            return replace(m, mass=m.mass[grid], stiffness=m.stiffness[grid])

        result.append(_changed(place, f"a test with the {body} clamped ({place.configuration})", held))
    return result


def _changed(place: _Place, text: str, change: Change) -> Option:
    families = (place.data[0].family, place.data[1].family)
    return _by_frequency(text, place.sides, families, place.band, change, place.frequency_std)


def _configurations(case: Case, sides: tuple[_Side, _Side], fit: FitSettings) -> list[Option]:
    """Configurations of the rig that were not measured."""
    result = []
    evidence = sides[0].problem.evidence
    measured = {e.measured.configuration for e in evidence}
    for c in case.rig.configurations:
        if c in measured:
            continue
        families = tuple(MatrixFamily(s.problem.rig, c, s.problem.space) for s in sides)
        place = _Place((evidence[0], evidence[0]), sides, fit) if evidence else None
        band = place.band if place else _DEFAULT_BAND
        sigma = place.frequency_std if place else max(fit.frequency_floor, _LEAST_FREQUENCY)
        result.append(
            _by_frequency(
                f"a test in configuration {c}", sides, (families[0], families[1]), band,
                lambda m, system: m, sigma,
            )
        )  # fmt: skip
    return result


def _harder(case: Case, sides: tuple[_Side, _Side]) -> list[Option]:
    """The same test with harder hits: the scatter falls, what the fits differ by already counts for more.

    Linear explanations do not depend on the force themselves. The scatter falls in proportion to the force; the
    noise level on top of it, which no harder hit lowers, stays.
    """
    gained, best, where = 0.0, 0.0, ""
    start = 0
    for e in sides[0].problem.evidence:
        m = case.measured[e.measured.configuration]
        count = len(m)
        both = [s.costs[start : start + count] for s in sides]
        start += count
        usable = np.isfinite(both[0]) & np.isfinite(both[1])
        difference = np.abs(np.where(usable, both[1], 0.0) - np.where(usable, both[0], 0.0))
        scatter = np.nan_to_num(m.frequency_std_hz / m.frequency_hz)
        fixed = e.relative_std**2 - np.minimum(scatter**2, e.relative_std**2)
        ratio = e.relative_std**2 / np.maximum(fixed + (scatter / _HARDER) ** 2, 1e-300)
        more = np.where(scatter > 0, difference * ratio, 0.0)
        gained += float(np.sum(more))
        if more.size and float(np.max(more)) > best:
            best = float(np.max(more))
            where = f"{m.frequency_hz[int(np.argmax(more))]:.1f} Hz ({m.configuration})"
    if not where:
        return []
    return [
        Option(
            f"the same hits {_HARDER:g} times as hard, with a third of the scatter",
            float(np.sqrt(gained)),
            f"the two differ most at {where}",
        )
    ]


def _body(dof: str) -> str:
    return dof.rpartition(".")[0]
