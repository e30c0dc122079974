"""Identification of an isolator: the published steps, then the posterior of the published model on whole loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.errors import EmaError
from ema_pipeline.inference import Posterior, anneal, descend, learn
from ema_pipeline.ingest.description import TestDescription
from ema_pipeline.loops.closed_form import bouc_wen_steps, closed_form, energy_lines, hysteresis_force
from ema_pipeline.loops.compare import loop_fits
from ema_pipeline.loops.model import (
    CUBIC,
    DAMPING,
    EFFECTS,
    EXPONENT,
    FORCE,
    RELAXATION,
    RHO,
    STIFFNESS,
    UNITS,
)
from ema_pipeline.loops.read import load_loops
from ema_pipeline.loops.sentences import failures
from ema_pipeline.loops.settings import LoopSettings
from ema_pipeline.loops.types import Estimate, IsolatorResult, Loop, LoopFit, LossFactor
from ema_pipeline.observations.loops import CHANNELS, LoopObservations, LoopProblem
from ema_pipeline.rigs.isolator import PLACE, isolator
from ema_pipeline.threads import single_blas_thread

HYSTERESIS_STIFFNESS = "hysteresis_stiffness"
SOURCE_MODEL = ("quadratic_stiffness", "cubic_stiffness", "viscous_damping", "hysteresis")
"""Effects of the published model of a metal-mesh isolator."""

ONE_FREQUENCY = "not fitted: tests at one frequency do not separate viscous from hysteretic loss"
_ALONE_STEPS = 30
_REASONS = {
    DAMPING: "a damper cannot be negative: the loss falls with frequency (relaxation), or friction with velocity",
    RELAXATION: "a relaxation cannot be negative: the loss does not fall like that of a Maxwell branch",
}


def analyse_loops(
    test: TestDescription,
    settings: LoopSettings | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> IsolatorResult:
    """Read all records of a hysteresis test and identify the isolator.

    Raises
    ------
    EmaError
        Names file, channel or record and what is wrong with it.
    """
    report_progress = progress or (lambda share, text: None)
    loops = load_loops(test, settings)
    report_progress(0.3, "the published model on all loops")
    return identify_isolator(loops, settings)


def identify_isolator(loops: Sequence[Loop], settings: LoopSettings | None = None) -> IsolatorResult:
    """Identify stiffness, viscous damping and hysteresis from force loops.

    Parameters
    ----------
    loops : sequence of Loop
        See `measure_loop`. Several amplitudes part stiffness from hysteresis, several frequencies viscous
        damping from hysteresis.
    settings : LoopSettings, optional

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
    line of its hysteresis. They are therefore shown, but the parameters come from the posterior of all points of
    all loops, which holds the calibration of both channels and what the model leaves.
    """
    if not loops:
        raise EmaError("no loops to identify an isolator from; record steady sine tests")
    s = settings or LoopSettings()
    with single_blas_thread():
        lines = energy_lines(loops, s.significance)
        driven = [loop.frequency_hz for loop in loops]
        several = max(driven) > 1.02 * min(driven)
        effects = [e for e in SOURCE_MODEL if several or e != "viscous_damping"]
        together = LoopObservations(isolator(), loops)
        published = Published.fitted(together, effects)
        parameters = published.estimates(s.significance)
        if not several:
            parameters[DAMPING] = Estimate(float("nan"), float("nan"), UNITS[DAMPING], False, ONE_FREQUENCY)
        flags = [f"{_frequencies(line.frequency_hz)} at {1e3 * line.amplitude_m:.3g} mm: {line.reason}"
                 for line in lines if not line.possible]  # fmt: skip
        flags += _giving(loops, s.significance) + _impossible(parameters, s.significance)
        relaxation: dict[str, Estimate] = {}
        if any(not line.possible for line in lines) or parameters[DAMPING].value < 0:
            relaxation = Published.fitted(together, [*effects, "relaxation"]).estimates(s.significance)
        fits = published.fits()
        alone = tuple(published.alone(i) for i in range(len(loops)))
        error = published.posterior.error
        largest = max(loops, key=lambda loop: loop.amplitude_m)
        return IsolatorResult(
            loops=tuple(loops),
            parameters=parameters,
            names=published.names,
            covariance=published.covariance(),
            closed_form=closed_form(loops, lines),
            closed_form_hysteresis=bouc_wen_steps(
                largest, hysteresis_force(largest, {DAMPING: 0.0, **published.values})
            ),
            energy=lines,
            loss=_loss_factors(loops, published),
            fits=fits,
            alone=alone,
            misfit_scale=max(1.0, error),
            relaxation=relaxation,
            flags=tuple(flags),
            notes=failures(loops, fits, alone, error),
        )


@dataclasses.dataclass(frozen=True)
class Published:
    """The published model, or one near it, with its posterior.

    Attributes
    ----------
    problem : LoopProblem
    posterior : Posterior
    """

    problem: LoopProblem
    posterior: Posterior

    @classmethod
    def fitted(cls, observations: LoopObservations, effects: Sequence[str]) -> Published:
        """Fitted to loops, with learned scatters."""
        problem = _problem(observations, effects)
        scatters = {n: s.start for n, s in observations.scatters.items()}
        found = anneal(problem, scatters, problem.start())
        return cls(problem, learn(problem, found, observations.scatters))

    @property
    def unknown_of(self) -> dict[str, int]:
        """Position of each parameter's unknown."""
        index = self.problem.unknowns.index
        known = {STIFFNESS: index[STIFFNESS]}
        for effect, names in EFFECTS.items():
            full = {name: f"{effect}@{PLACE}.{own}" for own, name in names.items()}
            known |= {name: index[f] for name, f in full.items() if f in index}
        return known

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of `covariance`."""
        return tuple(self.unknown_of)

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name."""
        given = self.problem.parameter_values(self.posterior.x)
        unknowns = self.problem.unknowns.names
        return {name: given[unknowns[i]] for name, i in self.unknown_of.items()}

    def covariance(self, *, as_read: bool = False) -> NDArray[np.float64]:
        """Covariance of the parameters, (n, n).

        Parameters
        ----------
        as_read : bool
            True for parameters in the channels' own units, their calibration taken as exact.
        """
        whole = self.posterior.covariance
        if as_read:
            fixed = [self.problem.unknowns.index[c] for c in CHANNELS]
            reach = whole[:, fixed]
            whole = whole - reach @ np.linalg.solve(whole[np.ix_(fixed, fixed)], reach.T)
        at = list(self.unknown_of.values())
        slope = np.array([self._slope(i) for i in at])
        return np.asarray(slope[:, None] * whole[np.ix_(at, at)] * slope)

    def _slope(self, i: int) -> float:
        """Derivative of a parameter by its unknown."""
        name, x = self.problem.unknowns.names[i], float(self.posterior.x[i])
        size = self.problem.sizes.get(name)
        return self.values[STIFFNESS] if size is None else size.slope(x)

    def estimates(self, significance: float) -> dict[str, Estimate]:
        """All parameters with 1 σ, and k_w·ρ."""
        values, covariance = self.values, self.covariance()
        found = {
            name: _estimate(
                values[name], float(np.sqrt(max(covariance[i, i], 0.0))), UNITS[name], significance
            )
            for i, name in enumerate(self.names)
        }
        slope = np.zeros(len(values))
        slope[self.names.index(FORCE)], slope[self.names.index(RHO)] = values[RHO], values[FORCE]
        std = float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))
        found[HYSTERESIS_STIFFNESS] = _estimate(values[FORCE] * values[RHO], std, "N/m", significance)
        for name, reason in _REASONS.items():
            e = found.get(name)
            if e is not None and e.value < -significance * e.std:
                found[name] = dataclasses.replace(e, note=reason)
        return found

    def fits(self) -> tuple[LoopFit, ...]:
        """All loops with the one set of parameters."""
        o = self.problem.observations
        return loop_fits(o.loops, self.problem.forces(self.posterior.x))

    def alone(self, i: int) -> LoopFit:
        """One loop with parameters of its own."""
        o = self.problem.observations
        one = o.with_loops([i])
        effects = [e.effect.id for e in self.problem.model.effects]
        problem = _problem(one, effects)
        scatters = {n: s.default for n, s in one.scatters.items()}
        found = descend(problem, scatters, self.posterior.x, steps=_ALONE_STEPS)
        return loop_fits(one.loops, problem.forces(found.x))[0]


def _problem(observations: LoopObservations, effects: Sequence[str]) -> LoopProblem:
    library = shipped_effects()
    return observations.problem([PlacedEffect(_as_published(library[e]), PLACE) for e in effects], {})


def _as_published(effect: Effect) -> Effect:
    """The effect as the source has it: Bouc-Wen with n = 1, and a damper of either sign."""
    if effect.id == "viscous_damping":
        (p,) = effect.parameters
        return dataclasses.replace(effect, parameters=(dataclasses.replace(p, minimum=-p.maximum),))
    if effect.id != "hysteresis":
        return effect
    rest = tuple(p for p in effect.parameters if EFFECTS["hysteresis"][p.name] != EXPONENT)
    return dataclasses.replace(
        effect,
        parameters=rest,
        edit=lambda assembly, place, values: effect.edit(assembly, place, {**values, "exponent": 1.0}),
    )


def _estimate(value: float, std: float, unit: str, significance: float) -> Estimate:
    identified = bool(abs(value) > significance * std)
    return Estimate(
        value, std, unit, identified, "" if identified else "not distinguishable from zero by these loops"
    )


def _giving(loops: Sequence[Loop], significance: float) -> list[str]:
    """Loops that are run through the wrong way round."""
    names = [loop.name for loop in loops if loop.energy_j < -significance * loop.energy_std_j]
    if not names:
        return []
    which = f"{len(names)} of {len(loops)} loops give" if len(names) > 1 else f"{names[0]} gives"
    return [
        f"{which} energy out in every cycle, which is impossible; check the sign of force or displacement"
    ]


def _impossible(parameters: Mapping[str, Estimate], significance: float) -> list[str]:
    return [
        f"{name.replace('_', ' ')} = {e.value:.4g} ± {e.std:.2g} {e.unit}: {_REASONS[name]}"
        for name, e in parameters.items()
        if name in _REASONS and e.value < -significance * e.std
    ]


def _loss_factors(loops: Sequence[Loop], published: Published) -> tuple[LossFactor, ...]:
    """η = E/(2πW) of every loop.

    W is the energy stored by the stiffness and by the linear term k_wρ of the hysteresis, averaged over both
    sides (source's Eq. 16), in which the quadratic term cancels: W = ½(K1 + k_wρ)X² + ¼K3X⁴. Errors of calibration
    are the same in E and in W.
    """
    v, names, covariance = published.values, published.names, published.covariance(as_read=True)
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
        stored_std = float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))
        if stored <= 0:
            found.append(LossFactor(loop.name, loop.frequency_hz, x, float("nan"), float("nan")))
            continue
        eta = loop.energy_j / (2 * np.pi * stored)
        relative = np.hypot(stored_std / stored, loop.energy_std_j / max(abs(loop.energy_j), 1e-300))
        found.append(LossFactor(loop.name, loop.frequency_hz, x, float(eta), float(abs(eta) * relative)))
    return tuple(found)


def _frequencies(f: NDArray[np.float64]) -> str:
    return ", ".join(f"{x:.3g}" for x in f) + " Hz"
