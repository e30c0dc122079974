"""The whole identification: the source's steps, then least squares on whole loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.hysteresis.closed_form import (
    bouc_wen_steps,
    closed_form,
    energy_lines,
    hysteresis_force,
)
from ema_pipeline.hysteresis.model import (
    ALL_TERMS,
    CUBIC,
    DAMPING,
    FORCE,
    QUADRATIC,
    RELAXATION,
    RHO,
    SIGMA,
    STIFFNESS,
    TIME,
    UNITS,
    Problem,
    Terms,
    loop_force,
)
from ema_pipeline.hysteresis.settings import HysteresisSettings
from ema_pipeline.hysteresis.types import Estimate, IsolatorResult, Loop, LoopFit, LossFactor, Rung
from ema_pipeline.hysteresis.words import failures
from ema_pipeline.threads import single_blas_thread

HYSTERESIS_STIFFNESS = "hysteresis_stiffness"

RUNGS: tuple[tuple[tuple[str, ...], Terms], ...] = (
    ((), (STIFFNESS,)),
    (("quadratic_stiffness", "cubic_stiffness"), (STIFFNESS, QUADRATIC, CUBIC)),
    (("viscous_damping",), (STIFFNESS, QUADRATIC, CUBIC, DAMPING)),
    (("hysteresis",), ALL_TERMS),
    (("relaxation",), (*ALL_TERMS, RELAXATION)),
)
"""Effects that each rung adds, and all terms of its model."""

ONE_FREQUENCY = "not fitted: tests at one frequency do not part viscous from hysteretic loss"

# Grids of starts: ρ as a share of 1/X of the largest loop, σ, and τ as a share of 1/ω.
_RHO, _SIGMA, _TIME = (0.2, 0.6, 2.0, 6.0, 30.0), (0.2, 0.5, 1.0), (0.3, 3.0)
_LIMITS = {RHO: (1e-4, 1e4), SIGMA: (0.01, 5.0), TIME: (1e-3, 1e3)}


def identify_isolator(loops: Sequence[Loop], settings: HysteresisSettings | None = None) -> IsolatorResult:
    """Identify stiffness, viscous damping and hysteresis from force loops.

    Parameters
    ----------
    loops : sequence of Loop
        See `measure_loop`. Several amplitudes part stiffness from hysteresis, several frequencies viscous
        damping from hysteresis.
    settings : HysteresisSettings, optional

    Returns
    -------
    IsolatorResult

    Raises
    ------
    EmaError
        Without loops.

    Notes
    -----
    The closed-form steps use a few points of single loops, and the backbone of a loop still holds the middle
    line of its hysteresis. They are therefore only the start of least squares on all points of all loops,
    whose covariance is widened where the model does not reach the data's own accuracy.
    """
    if not loops:
        raise EmaError("no loops to identify an isolator from; record steady sine tests")
    s = settings or HysteresisSettings()
    with single_blas_thread():
        lines = energy_lines(loops, s.significance)
        start = closed_form(loops, lines)
        terms = ALL_TERMS if _several_frequencies(loops) else tuple(t for t in ALL_TERMS if t != DAMPING)
        fit = _fit(loops, terms, start)
        parameters, covariance, scale = _estimates(fit, s.significance)
        if DAMPING not in terms:
            parameters[DAMPING] = Estimate(float("nan"), float("nan"), UNITS[DAMPING], False, ONE_FREQUENCY)
        alone = tuple(_loop_fits(_fit((loop,), terms, fit.values))[0] for loop in loops)
        flags = [f"{_frequencies(line.frequency_hz)} at {_mm(line.amplitude_m)}: {line.reason}"
                 for line in lines if not line.possible]  # fmt: skip
        flags += _impossible(parameters, s.significance)
        relaxation: dict[str, Estimate] = {}
        negative = any(not line.possible for line in lines) or parameters[DAMPING].value < 0
        if negative:
            with_branch = _fit(loops, (*terms, RELAXATION), fit.values)
            relaxation = _estimates(with_branch, s.significance)[0]
        fits = _loop_fits(fit)
        largest = max(loops, key=lambda loop: loop.amplitude_m)
        return IsolatorResult(
            loops=tuple(loops),
            parameters=parameters,
            names=fit.names,
            covariance=covariance,
            closed_form=start,
            closed_form_hysteresis=bouc_wen_steps(
                largest, hysteresis_force(largest, {DAMPING: 0.0, **fit.values})
            ),
            energy=lines,
            loss=_loss_factors(loops, fit, covariance),
            fits=fits,
            alone=alone,
            misfit_scale=scale,
            relaxation=relaxation,
            ladder=_ladder(loops, fit, s, with_relaxation=negative),
            flags=tuple(flags),
            notes=failures(loops, fits, alone, scale),
        )


@dataclass(frozen=True)
class _Fit:
    """A least-squares fit: its problem, the values, the offsets and the weighted residuals."""

    problem: Problem
    values: dict[str, float]
    linear: NDArray[np.float64]
    residual: NDArray[np.float64]

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.problem.terms, *self.problem.shape_names)

    @property
    def shape(self) -> dict[str, float]:
        return {n: self.values[n] for n in self.problem.shape_names}


def _fit(loops: Sequence[Loop], terms: Terms, start: Mapping[str, float]) -> _Fit:
    """Best of the starts on the grid and the given one, refined."""
    problem = Problem(loops, terms)
    names = problem.shape_names
    amplitude = max(loop.amplitude_m for loop in loops)
    omega = 2 * np.pi * float(np.mean([loop.frequency_hz for loop in loops]))
    unit = {RHO: 1 / amplitude, SIGMA: 1.0, TIME: 1 / omega}

    def shape_of(theta: NDArray[np.float64]) -> dict[str, float]:
        return {n: float(np.exp(t)) * unit[n] for n, t in zip(names, theta, strict=True)}

    theta = np.zeros(0)
    if names:
        low = np.log([_LIMITS[n][0] for n in names])
        high = np.log([_LIMITS[n][1] for n in names])
        starts = _starts(names, start, unit)
        starts = [np.clip(t, low + 1e-6, high - 1e-6) for t in starts]
        cost = [float(np.sum(problem.solve(shape_of(t))[1] ** 2)) for t in starts]
        best = None

        def left(theta: NDArray[np.float64]) -> NDArray[np.float64]:
            return problem.solve(shape_of(theta))[1]

        for i in np.argsort(cost)[: 1 if cost[0] <= 1.1 * min(cost) else 2]:
            found = scipy.optimize.least_squares(
                left,
                starts[i],
                bounds=(low, high),
                x_scale=0.3,
                diff_step=[1e-4] * len(names),
                xtol=1e-8,
                ftol=1e-9,
                max_nfev=40,
            )
            best = found if best is None or found.cost < best.cost else best
        assert best is not None
        theta = best.x
    shape = shape_of(theta)
    linear, residual = problem.solve(shape)
    values = {n: float(v) for n, v in zip(terms, linear, strict=False)} | shape
    return _Fit(problem, values, linear, residual)


def _starts(
    names: tuple[str, ...], start: Mapping[str, float], unit: Mapping[str, float]
) -> list[NDArray[np.float64]]:
    grids = {RHO: _RHO, SIGMA: _SIGMA, TIME: _TIME}
    given = []
    if all(np.isfinite(start.get(n, np.nan)) and start[n] > 0 for n in names if n != TIME):
        rest = [start[n] / unit[n] if n in start else 1.0 for n in names]
        given.append(np.log(rest))
    if TIME in names and given:
        at = names.index(TIME)
        for t in _TIME:
            other = given[0].copy()
            other[at] = np.log(t)
            given.append(other)
        return given
    mesh = np.meshgrid(*(np.log(grids[n]) for n in names), indexing="ij")
    return given + list(np.stack([m.ravel() for m in mesh], axis=1))


def _estimates(fit: _Fit, significance: float) -> tuple[dict[str, Estimate], NDArray[np.float64], float]:
    """Estimates of all parameters, their covariance, and the factor that it was widened by."""
    problem, names = fit.problem, fit.names
    columns = problem.columns(fit.shape)
    moved = []
    for name in problem.shape_names:
        step = 1e-4 * fit.values[name]
        change = problem.columns({**fit.shape, name: fit.values[name] + step}) - columns
        moved.append(change @ fit.linear / step)
    count, loops = len(problem.terms), len(problem.loops)
    jacobian = np.column_stack([columns, *moved])
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0] = 1.0
    dof = max(len(fit.residual) - jacobian.shape[1], 1)
    scale = float(np.sqrt(max(1.0, np.sum(fit.residual**2) / dof)))
    whole = (
        scale**2 * np.linalg.pinv((jacobian / size).T @ (jacobian / size), rcond=1e-13) / np.outer(size, size)
    )
    shift = whole / scale**2 @ jacobian.T @ _displacement_errors(fit)
    whole = whole + shift @ shift.T
    keep = [*range(count), *range(count + loops, count + loops + len(problem.shape_names))]
    covariance = whole[np.ix_(keep, keep)]
    result = {}
    for i, name in enumerate(names):
        value, std = fit.values[name], float(np.sqrt(np.maximum(covariance[i, i], 0.0)))
        identified = abs(value) > significance * std
        note = "" if identified else "not told from zero by these loops"
        result[name] = Estimate(value, std, UNITS[name], bool(identified), note)
    if FORCE in names:
        a, b = names.index(FORCE), names.index(RHO)
        slope = np.zeros(len(names))
        slope[a], slope[b] = fit.values[RHO], fit.values[FORCE]
        product = fit.values[FORCE] * fit.values[RHO]
        std = float(np.sqrt(np.maximum(slope @ covariance @ slope, 0.0)))
        known = abs(product) > significance * std
        result[HYSTERESIS_STIFFNESS] = Estimate(
            product, std, "N/m", bool(known), "" if known else "not told from zero by these loops"
        )
    for name, reason in _REASONS.items():
        e = result.get(name)
        if e is not None and e.value < -significance * e.std:
            result[name] = dataclasses.replace(e, note=reason)
    return result, covariance, scale


def _displacement_errors(fit: _Fit) -> NDArray[np.float64]:
    """Weighted change of the model's force by one standard deviation of each coefficient of each loop's
    displacement, (n_points, n_coefficients): the displacement is measured too."""
    columns, start = [], 0
    total = len(fit.residual)
    for loop in fit.problem.loops:
        n = len(loop.force)
        step = 1e-4 * loop.amplitude_m
        before = loop_force(fit.values, loop.series, loop.frequency_hz, loop.phase)
        for change in step * np.eye(len(loop.series)):
            moved = loop_force(fit.values, loop.series + change, loop.frequency_hz, loop.phase)
            column = np.zeros(total)
            column[start : start + n] = (moved - before) / step * loop.displacement_std_m / loop.force_std_n
            columns.append(column)
        start += n
    return np.column_stack(columns)


_REASONS = {
    DAMPING: "a negative damper cannot be: the loss falls with frequency (relaxation), or friction with rate",
    FORCE: "a negative hysteresis force would give energy out every cycle: it cannot be",
    STIFFNESS: "a negative stiffness cannot be: check the sign of force or displacement",
    RELAXATION: "a negative relaxation cannot be: the loss does not fall as a Maxwell branch's does",
}


def _impossible(parameters: Mapping[str, Estimate], significance: float) -> list[str]:
    return [
        f"{name.replace('_', ' ')} = {e.value:.4g} ± {e.std:.2g} {e.unit}: {_REASONS[name]}"
        for name, e in parameters.items()
        if name in _REASONS and e.value < -significance * e.std
    ]


def _loop_fits(fit: _Fit) -> tuple[LoopFit, ...]:
    fits, start = [], 0
    for loop in fit.problem.loops:
        stop = start + len(loop.force)
        force = loop.force + fit.residual[start:stop] * loop.force_std_n
        start = stop
        energy = float(np.mean(force * loop.velocity)) / loop.frequency_hz
        difference = float(np.sqrt(np.mean((force - loop.force) ** 2)))
        fits.append(
            LoopFit(
                name=loop.name,
                force=force,
                energy_j=energy,
                energy_error=energy / loop.energy_j - 1 if loop.energy_j else float("nan"),
                misfit=difference / max(0.5 * float(np.ptp(loop.force)), 1e-300),
            )
        )
    return tuple(fits)


def _loss_factors(
    loops: Sequence[Loop], fit: _Fit, covariance: NDArray[np.float64]
) -> tuple[LossFactor, ...]:
    """η = E/(2πW) of every loop.

    W is the energy stored by the stiffness and by the linear term k_wρ of the hysteresis, averaged over both
    sides (source's Eq. 16), in which the quadratic term cancels: W = ½(K1 + k_wρ)X² + ¼K3X⁴.
    """
    v, names = fit.values, fit.names
    found = []
    for loop in loops:
        x = loop.amplitude_m
        stored = 0.5 * (v[STIFFNESS] + v[FORCE] * v[RHO]) * x**2 + 0.25 * v[CUBIC] * x**4
        slope = np.zeros(len(names))
        for name, value in (
            (STIFFNESS, 0.5 * x**2),
            (CUBIC, 0.25 * x**4),
            (FORCE, 0.5 * v[RHO] * x**2),
            (RHO, 0.5 * v[FORCE] * x**2),
        ):
            slope[names.index(name)] = value
        stored_std = float(np.sqrt(np.maximum(slope @ covariance @ slope, 0.0)))
        if stored <= 0:
            found.append(LossFactor(loop.name, loop.frequency_hz, x, float("nan"), float("nan")))
            continue
        eta = loop.energy_j / (2 * np.pi * stored)
        relative = np.hypot(stored_std / stored, loop.energy_std_j / max(abs(loop.energy_j), 1e-300))
        found.append(LossFactor(loop.name, loop.frequency_hz, x, float(eta), float(abs(eta) * relative)))
    return tuple(found)


def _ladder(
    loops: Sequence[Loop], full: _Fit, settings: HysteresisSettings, *, with_relaxation: bool
) -> tuple[Rung, ...]:
    """Error of every rung, on all loops and on loops that were left out of its fit."""
    parts = min(settings.held_out_parts, len(loops))
    rungs: list[Rung] = []
    effects: tuple[str, ...] = ()
    for added, terms in RUNGS:
        if RELAXATION in terms and not with_relaxation:
            continue
        if DAMPING not in full.problem.terms:
            if added == ("viscous_damping",):
                continue
            terms = tuple(t for t in terms if t != DAMPING)
        effects += tuple(f"{e}@isolator" for e in added)
        fit = full if terms == full.problem.terms else _fit(loops, terms, full.values)
        rungs.append(Rung(effects, _rms(fit.residual), _held_out(loops, terms, fit, parts)))
    return tuple(rungs)


def _held_out(loops: Sequence[Loop], terms: Terms, fit: _Fit, parts: int) -> float:
    if parts < 2:
        return float("nan")
    left = []
    for part in range(parts):
        kept = [loop for i, loop in enumerate(loops) if i % parts != part]
        others = [loop for i, loop in enumerate(loops) if i % parts == part]
        trained = _fit(kept, terms, fit.values)
        left.append(Problem(others, terms).residual(trained.linear, trained.shape))
    return _rms(np.concatenate(left))


def _several_frequencies(loops: Sequence[Loop]) -> bool:
    f = [loop.frequency_hz for loop in loops]
    return max(f) > 1.02 * min(f)


def _rms(residual: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _mm(amplitude_m: float) -> str:
    return f"{1e3 * amplitude_m:.3g} mm"


def _frequencies(f: NDArray[np.float64]) -> str:
    return ", ".join(f"{x:.3g}" for x in f) + " Hz"
