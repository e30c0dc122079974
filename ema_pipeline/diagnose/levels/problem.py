"""Fit of a model, nonlinear or not, to measured hits by simulating them with the measured force records.

What a linear model gets wrong, it gets wrong in proportion to the force: the same error of the FRF at every force
level. Such an error, up to the share `common` of the measured response, is integrated out, so that an imperfect
linear model (a mode of the foundation, planets that differ) neither hides nor feigns an effect that depends on the
level.

References
----------
K. Worden, G. R. Tomlinson, *Nonlinearity in Structural Dynamics*, 2001, section 2.4 (normalised mean square error:
the square of the misfit used here). M. C. Kennedy, A. O'Hagan, "Bayesian calibration of computer models", *J. R.
Stat. Soc. B* 63 (2001) 425-464 (model discrepancy integrated out).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.levels.data import HitWindows
from ema_pipeline.errors import EmaError
from ema_pipeline.fit.space import Space, make_space
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.batch import Blows, batch_response
from ema_pipeline.mechanics.batch_lines import batch_lines
from ema_pipeline.mechanics.system import sensor_rows
from ema_pipeline.rigs.types import Rig

_T = TypeVar("_T", np.float64, np.complex128)

_STEP = 1e-3
_TRUSTED = 0.3
"""A step whose gain is foreseen to this share is followed by another without new finite differences."""
_CHUNK = 256
"""Pairs of model and hit that are simulated side by side."""


class TimeProblem:
    """A rig against windows of measured hits.

    Parameters
    ----------
    rig : Rig
        With its effects, if any.
    windows : sequence of HitWindows
        One per configuration.
    substeps : int
        Steps of the integration per sample.
    """

    def __init__(self, rig: Rig, windows: Sequence[HitWindows], substeps: int) -> None:
        self.rig = rig
        self.windows = tuple(windows)
        self.substeps = substeps
        used = {n for w in windows for n in rig.used(w.configuration)}
        self.space: Space = make_space([p for n, p in rig.parameters.items() if n in used])

    def simulate(self, points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """What the sensors read at points (B, P): per configuration (B, n_hits, n_sensors, n_samples).

        Raises
        ------
        EmaError
            Where the motion of a model grows without bound.
        """
        return [
            _joined([batch_response(some, blows, self.substeps) for some in parts])
            for w in self.windows
            for blows, parts in [self._parts(w, points)]
        ]

    def lines(self, points: NDArray[np.float64]) -> list[NDArray[np.complex128]]:
        """The spectra of that as `HitWindows.spectra` gives them, (B, n_hits, n_sensors, n_lines), much faster.

        NaN where the motion of a model grows without bound.

        Raises
        ------
        EmaError
            Where an element with a memory has no solution.
        """
        return [
            _joined([batch_lines(some, blows, self.substeps, w.fade_s, w.lines) for some in parts])
            for w in self.windows
            for blows, parts in [self._parts(w, points)]
        ]

    def _parts(self, w: HitWindows, points: NDArray[np.float64]) -> tuple[Blows, list[list[Assembly]]]:
        """Blows and models of one configuration, the models in parts."""
        assemblies = [self._assembly(w, x) for x in points]
        system = assemblies[0].system()
        blows = Blows(
            w.sample_rate_hz, w.force, sensor_rows(system, w.impacts), sensor_rows(system, w.sensors),
            w.quantities,
        )  # fmt: skip
        step = max(1, _CHUNK // len(w.names))
        return blows, [assemblies[i : i + step] for i in range(0, len(assemblies), step)]

    def _assembly(self, w: HitWindows, x: NDArray[np.float64]) -> Assembly:
        return self.rig.assembly(w.configuration, self.space.named(x))


@dataclass(frozen=True)
class Whitening:
    """How the differences of measured and simulated lines of one configuration are weighted.

    Attributes
    ----------
    scale : ndarray, (n_hits, n_sensors, n_lines)
        One over the standard uncertainty of what is not common to all levels; 0 where a sensor is absent.
    worth : ndarray, (n_hits, n_sensors, n_lines)
        Square root of the number of independent data that a line stands for.
    common : ndarray, (n_hits, n_sensors, n_lines)
        Direction, of length 1 over the hits of each impact point, of an error common to all levels.
    taken : ndarray, (n_points, n_sensors, n_lines)
        Share of that direction which is taken off.
    point : ndarray of int, (n_hits,)
        Impact point of each hit.
    measured : ndarray, (n_hits, n_sensors, n_lines)
    """

    scale: NDArray[np.float64]
    worth: NDArray[np.float64]
    common: NDArray[np.complex128]
    taken: NDArray[np.float64]
    point: NDArray[np.int64]
    measured: NDArray[np.complex128]

    def applied(self, simulated: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Weighted differences for simulated lines (B, n_hits, n_sensors, n_lines)."""
        r = simulated - self.measured  # changed in place: it is large
        r *= self.scale
        for point, taken in enumerate(self.taken):
            hits = [(r[:, i], self.common[i]) for i in np.flatnonzero(self.point == point)]
            along = sum(own * common.conj() for own, common in hits) * taken
            for own, common in hits:
                own -= along * common
        r *= self.worth
        return np.asarray(r)


@dataclass(frozen=True)
class NoiseFloor:
    """What may be left beside the sensors' noise, as shares of the measured amplitude around each line.

    Attributes
    ----------
    own : float
        At each hit by itself.
    common : float
        In the FRF, alike at every force level.
    """

    own: float
    common: float


def whitenings(windows: Sequence[HitWindows], floor: NoiseFloor, data_per_mode: float) -> list[Whitening]:
    """Weights where one mode in one hit is worth `data_per_mode` independent numbers.

    A line's real and imaginary part are worth numbers in proportion to 1/f, since a mode of given damping ratio
    spreads over lines in proportion to its frequency, and to the share of their power that is no noise.
    """
    result = []
    for w in windows:
        sigma, size, signal = w.sigma(floor.own)
        even = signal / w.frequency_hz
        total = np.sum(even, axis=(1, 2), keepdims=True)
        worth = data_per_mode * w.modes * even / np.maximum(total, 1e-300)
        measured = w.spectra(w.measured)
        force = w.spectra(w.force)
        known = {d: i for i, d in enumerate(dict.fromkeys(str(d) for d in w.impacts))}
        point = np.array([known[str(d)] for d in w.impacts], dtype=np.int64)
        common = np.zeros(measured.shape, dtype=complex)
        taken = np.zeros((len(known), *measured.shape[1:]))
        for k in range(len(known)):
            at = np.flatnonzero(point == k)
            per_newton = np.sum(size[at], axis=0) / np.sum(np.abs(force[at]), axis=0)
            u = floor.common * per_newton * force[at][:, None] / sigma[at]
            length = np.sqrt(np.sum(np.abs(u) ** 2, axis=0))
            common[at] = u / np.maximum(length, 1e-300)
            taken[k] = 1 - 1 / np.sqrt(1 + length**2)
        result.append(Whitening(1 / sigma, np.sqrt(worth), common, taken, point, measured))
    return result


def residuals(
    problem: TimeProblem, weights: Sequence[Whitening], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weighted differences of measured and simulated lines, real and imaginary in turn, (B, n).

    Raises
    ------
    EmaError
        Where the motion of a model has no solution.
    """
    r = weighted(weights, problem.lines(points))
    if not np.all(np.isfinite(np.sum(r, axis=1))):
        raise EmaError("the motion of a model grows without bound: check the values of its effects")
    return r


def weighted(weights: Sequence[Whitening], lines: Sequence[NDArray[np.complex128]]) -> NDArray[np.float64]:
    """The same for simulated lines."""
    parts = []
    for weight, simulated in zip(weights, lines, strict=True):
        parts.append(weight.applied(simulated).reshape(len(simulated), -1).view(np.float64))
    return _joined(parts, axis=1)


def _joined(parts: Sequence[NDArray[_T]], axis: int = 0) -> NDArray[_T]:
    """Arrays as one; a single one, which is large, is not copied."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)


@dataclass(frozen=True)
class TimeFit:
    """A model at its optimum.

    Attributes
    ----------
    x : ndarray, (P,)
    values : dict of str to float
    objective : float
        -2 log posterior up to a constant: weighted sum of squares, and squared shifts in tolerances.
    squares : float
        The weighted sum of squares of the data alone.
    hessian : ndarray, (P, P)
        Gauss-Newton's, priors included.
    """

    x: NDArray[np.float64]
    values: dict[str, float]
    objective: float
    squares: float
    hessian: NDArray[np.float64]


def fit(
    problem: TimeProblem,
    weights: Sequence[Whitening],
    start: NDArray[np.float64],
    most: int,
    known: Mapping[str, NDArray[np.float64]] | None = None,
    tolerance: float = 0.05,
) -> TimeFit:
    """Levenberg-Marquardt steps with finite differences, all models of a step side by side.

    Where a step does what was foreseen, the slopes are brought up to date by what it found (C. G. Broyden, *Math.
    Comp.* 19 (1965) 577-593) instead of by new differences.

    Parameters
    ----------
    problem : TimeProblem
    weights : sequence of Whitening
    start : ndarray, (P,)
    most : int
        Steps at most.
    known : mapping of str to ndarray (n,), optional
        Slopes of the weighted differences near the start, of some of the parameters: tried before they are sought.
    tolerance : float
        Ends where a step lowers the objective by less than this and a thousandth.

    Returns
    -------
    TimeFit
        With an infinite objective where the motion has no solution at the start.
    """
    space = problem.space
    prior = space.has_prior.astype(float)
    x = np.clip(np.asarray(start, dtype=float), space.low, space.high)
    damping, value = 1e-3, np.inf
    normal = np.eye(x.size)
    slopes: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    trusted = known or {}
    while True:
        fresh = slopes is None and not trusted
        try:
            r, jacobian = linearised(problem, weights, x, trusted) if slopes is None else slopes
        except EmaError:  # on the edge of what has a solution
            break
        value = float(r @ r) + float(prior @ x**2)
        normal = jacobian @ jacobian.T + np.diag(prior)
        gradient = jacobian @ r + prior * x
        if most <= 0:
            break
        ladder = damping * np.array([0.1, 10.0, 1000.0])
        scale = np.diag(normal).clip(1e-9)
        trials = np.array(
            [space.retract(x, -np.linalg.solve(normal + d * np.diag(scale), gradient)) for d in ladder]
        )
        tried = _tried(problem, weights, trials)
        found = np.sum(tried**2, axis=1) + trials**2 @ prior
        best = int(np.argmin(found))
        step = trials[best] - x
        ahead = r + step @ jacobian
        foreseen = value - float(ahead @ ahead) - float(prior @ trials[best] ** 2)
        fell = value - float(found[best])
        small = tolerance + 1e-3 * value
        follows = abs(fell - foreseen) <= _TRUSTED * foreseen + tolerance
        if fell > 0:
            x, value, most = trials[best], float(found[best]), most - 1
            damping = float(np.clip(ladder[best], 1e-6, 1e6))
        if fell < small and (fresh or follows):
            break
        trusted, slopes = {}, None
        if follows and fell > 0:
            slopes = tried[best], jacobian + np.outer(step, (tried[best] - ahead) / (step @ step))
    return TimeFit(x, space.named(x), value, value - float(prior @ x**2), normal)


def linearised(
    problem: TimeProblem,
    weights: Sequence[Whitening],
    x: NDArray[np.float64],
    known: Mapping[str, NDArray[np.float64]] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Residual (n,) and Jacobian (P, n) by forward differences that stay inside the bounds.

    Rows of parameters in `known` are taken from there.
    """
    names, taken = problem.space.names, known or {}
    sought = [i for i, n in enumerate(names) if n not in taken]
    step = np.where(x + _STEP > problem.space.high, -_STEP, _STEP)
    r = residuals(problem, weights, np.vstack([x[None], x + np.diag(step)[sought]]))
    jacobian = np.empty((x.size, r.shape[1]))
    jacobian[sought] = (r[1:] - r[0]) / step[sought, None]
    for i, name in enumerate(names):
        if name in taken:
            jacobian[i] = taken[name]
    return r[0], jacobian


def objectives(
    problem: TimeProblem, weights: Sequence[Whitening], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """-2 log posterior at points, (B,); infinite where the motion of a model has no solution."""
    prior = problem.space.has_prior.astype(float)
    return np.sum(_tried(problem, weights, points) ** 2, axis=1) + points**2 @ prior


def _tried(
    problem: TimeProblem, weights: Sequence[Whitening], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Weighted differences at points, (B, n); infinite where the motion of a model has no solution."""
    try:
        r = weighted(weights, problem.lines(points))
    except EmaError:
        if len(points) == 1:
            return np.full((1, 1), np.inf)
        apart = [_tried(problem, weights, p[None]) for p in points]
        most = max(a.shape[1] for a in apart)
        return np.concatenate([np.broadcast_to(a, (1, most)) for a in apart])
    r[~np.isfinite(np.sum(r, axis=1))] = np.inf
    return r


def misfits(problem: TimeProblem, values: Mapping[str, float]) -> list[NDArray[np.float64]]:
    """Normalised time-domain misfit of each hit, per configuration (n_hits,).

    Root-mean-square of measured - simulated over that of the measured, over all sensors, in the band.
    """
    simulated = problem.simulate(problem.space.point(values)[None])
    return [hit_misfits(w, s[0]) for w, s in zip(problem.windows, simulated, strict=True)]


def hit_misfits(w: HitWindows, simulated: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same for given signals, (n_hits,)."""
    use = w.present[..., None]
    measured = w.in_band(w.measured) * use
    difference = measured - w.in_band(simulated) * use
    return np.asarray(np.sqrt(np.sum(difference**2, axis=(1, 2)) / np.sum(measured**2, axis=(1, 2))))
