"""The whole identification: the source's steps, then least squares on whole loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.loops.closed_form import (
    bouc_wen_steps,
    closed_form,
    energy_lines,
    hysteresis_force,
)
from ema_pipeline.loops.effects import Structure
from ema_pipeline.loops.fitting import Fitted, fit, loop_set
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.model import CUBIC, DAMPING, FORCE, RELAXATION, RHO, STIFFNESS, UNITS
from ema_pipeline.loops.search import widening_of
from ema_pipeline.loops.settings import HysteresisSettings
from ema_pipeline.loops.types import Estimate, IsolatorResult, Loop, LoopFit, LossFactor
from ema_pipeline.loops.words import failures
from ema_pipeline.threads import single_blas_thread

HYSTERESIS_STIFFNESS = "hysteresis_stiffness"
SOURCE_MODEL = Structure(("quadratic_stiffness", "cubic_stiffness", "viscous_damping", "hysteresis"))
"""The published model of a metal-mesh isolator."""

ONE_FREQUENCY = "not fitted: tests at one frequency do not part viscous from hysteretic loss"


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
    line of its hysteresis. They are therefore shown, but the parameters come from least squares on all points of
    all loops, whose covariance is widened where the model does not reach the data's own accuracy.
    """
    if not loops:
        raise EmaError("no loops to identify an isolator from; record steady sine tests")
    s = settings or HysteresisSettings()
    with single_blas_thread():
        lines = energy_lines(loops, s.significance)
        start = closed_form(loops, lines)
        structure = SOURCE_MODEL if _several_frequencies(loops) else SOURCE_MODEL.without("viscous_damping")
        together = loop_set(loops, structure)
        fitted = fit(together, structure, physical=False)
        parameters, covariance, scale = _estimates(fitted, together, s.significance)
        if DAMPING not in fitted.values:
            parameters[DAMPING] = Estimate(float("nan"), float("nan"), UNITS[DAMPING], False, ONE_FREQUENCY)
        alone = tuple(_alone(loop, structure, fitted) for loop in loops)
        flags = [f"{_frequencies(line.frequency_hz)} at {_mm(line.amplitude_m)}: {line.reason}"
                 for line in lines if not line.possible]  # fmt: skip
        flags += _giving(loops, s.significance) + _impossible(parameters, s.significance)
        relaxation: dict[str, Estimate] = {}
        if any(not line.possible for line in lines) or parameters[DAMPING].value < 0:
            branch = fit(together, structure.plus("relaxation"), fitted.values, physical=False)
            relaxation = _estimates(branch, together, s.significance)[0]
        fits = loop_fits(together, fitted)
        largest = max(loops, key=lambda loop: loop.amplitude_m)
        return IsolatorResult(
            loops=tuple(loops),
            parameters=parameters,
            names=fitted.names,
            covariance=covariance,
            closed_form=start,
            closed_form_hysteresis=bouc_wen_steps(
                largest, hysteresis_force(largest, {DAMPING: 0.0, **fitted.values})
            ),
            energy=lines,
            loss=_loss_factors(loops, fitted, covariance),
            fits=fits,
            alone=alone,
            misfit_scale=scale,
            relaxation=relaxation,
            flags=tuple(flags),
            notes=failures(loops, fits, alone, scale),
        )


def loop_fits(loops: LoopSet, fitted: Fitted) -> tuple[LoopFit, ...]:
    """The model's force, offset included, beside that of every loop."""
    force, _ = loops.motion.force(fitted.values, fitted.structure.terms)
    fits = []
    for loop, part, scale in zip(loops.loops, loops.parts, fitted.scales, strict=True):
        model = scale * force[part]
        model = model + float(np.mean(loop.force - model))
        energy = float(np.mean(model * loop.velocity)) / loop.frequency_hz
        difference = float(np.sqrt(np.mean((model - loop.force) ** 2)))
        fits.append(
            LoopFit(
                name=loop.name,
                force=model,
                energy_j=energy,
                energy_error=energy / loop.energy_j - 1 if loop.energy_j else float("nan"),
                misfit=difference / max(0.5 * float(np.ptp(loop.force)), 1e-300),
            )
        )
    return tuple(fits)


def _alone(loop: Loop, structure: Structure, together: Fitted) -> LoopFit:
    one = loop_set((loop,), structure)
    return loop_fits(one, fit(one, structure, together.values, physical=False))[0]


def _estimates(
    fitted: Fitted, loops: LoopSet, significance: float
) -> tuple[dict[str, Estimate], NDArray[np.float64], float]:
    """Estimates of all parameters, their covariance, and the factor that it was widened by."""
    names = fitted.names
    widening = widening_of(fitted, loops)
    covariance = fitted.covariance(widening)
    result = {}
    for i, name in enumerate(names):
        value, std = fitted.values[name], float(np.sqrt(np.maximum(covariance[i, i], 0.0)))
        identified = abs(value) > significance * std
        note = "" if identified else "not told from zero by these loops"
        result[name] = Estimate(value, std, UNITS[name], bool(identified), note)
    if FORCE in names:
        a, b = names.index(FORCE), names.index(RHO)
        slope = np.zeros(len(names))
        slope[a], slope[b] = fitted.values[RHO], fitted.values[FORCE]
        product = fitted.values[FORCE] * fitted.values[RHO]
        std = float(np.sqrt(np.maximum(slope @ covariance @ slope, 0.0)))
        known = abs(product) > significance * std
        result[HYSTERESIS_STIFFNESS] = Estimate(
            product, std, "N/m", bool(known), "" if known else "not told from zero by these loops"
        )
    for name, reason in _REASONS.items():
        e = result.get(name)
        if e is not None and e.value < -significance * e.std:
            result[name] = dataclasses.replace(e, note=reason)
    reduced = fitted.chi2 / max(loops.freedom - len(names), 1)
    return result, covariance, float(np.sqrt(max(1.0, reduced)))


_REASONS = {
    DAMPING: "a negative damper cannot be: the loss falls with frequency (relaxation), or friction with rate",
    FORCE: "a negative hysteresis force would give energy out every cycle: it cannot be",
    STIFFNESS: "a negative stiffness cannot be: check the sign of force or displacement",
    RELAXATION: "a negative relaxation cannot be: the loss does not fall as a Maxwell branch's does",
}


def _giving(loops: Sequence[Loop], significance: float) -> list[str]:
    """Loops that are run through the wrong way round."""
    names = [loop.name for loop in loops if loop.energy_j < -significance * loop.energy_std_j]
    if not names:
        return []
    which = f"{len(names)} of {len(loops)} loops give" if len(names) > 1 else f"{names[0]} gives"
    return [f"{which} energy out every cycle: it cannot be; check the sign of force or displacement"]


def _impossible(parameters: Mapping[str, Estimate], significance: float) -> list[str]:
    return [
        f"{name.replace('_', ' ')} = {e.value:.4g} ± {e.std:.2g} {e.unit}: {_REASONS[name]}"
        for name, e in parameters.items()
        if name in _REASONS and e.value < -significance * e.std
    ]


def _loss_factors(
    loops: Sequence[Loop], fitted: Fitted, covariance: NDArray[np.float64]
) -> tuple[LossFactor, ...]:
    """η = E/(2πW) of every loop.

    W is the energy stored by the stiffness and by the linear term k_wρ of the hysteresis, averaged over both
    sides (source's Eq. 16), in which the quadratic term cancels: W = ½(K1 + k_wρ)X² + ¼K3X⁴.
    """
    v, names = fitted.values, fitted.names
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


def _several_frequencies(loops: Sequence[Loop]) -> bool:
    f = [loop.frequency_hz for loop in loops]
    return max(f) > 1.02 * min(f)


def _mm(amplitude_m: float) -> str:
    return f"{1e3 * amplitude_m:.3g} mm"


def _frequencies(f: NDArray[np.float64]) -> str:
    return ", ".join(f"{x:.3g}" for x in f) + " Hz"
