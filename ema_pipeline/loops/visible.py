"""What loops can show: the smallest effects that they would reveal, and the loop that would tell two models apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.effects import LINEAR, PARAMETERS
from ema_pipeline.loops.fitting import Fitted, fit
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.model import EXPONENT, GAP, RHO, SIGMA, TIME, UNITS, Motion
from ema_pipeline.loops.types import Loop
from ema_pipeline.mechanics.fourier import fourier, fourier_slope

MARGIN = 1.6
"""Standard deviations above the threshold at which 19 of 20 tests show an effect."""
_TYPICAL = {RHO: 2.0, SIGMA: 0.5, EXPONENT: 1.0, TIME: 1.0}
_PLAY = 0.01
_TRIED = ((0.5, 1.0), (2.0, 1.0), (4.0, 1.0), (1.0, 0.5), (1.0, 1.5))


@dataclass(frozen=True)
class Limit:
    """The smallest size of an effect that loops show in 19 of 20 tests.

    Attributes
    ----------
    effect : str
    size : float
        Of the effect's first parameter.
    unit : str
    share : float
        Largest force of that size over the measured one.
    note : str
        For which shape it holds.
    """

    effect: str
    size: float
    unit: str
    share: float
    note: str


def smallest_visible(
    loops: LoopSet, fitted: Fitted, effect: str, widening: float, prior_odds: float, probability: float
) -> Limit:
    """The smallest size of one more effect that would be claimed, to first order, for a typical shape.

    Parameters
    ----------
    loops : LoopSet
    fitted : Fitted
        The model as it stands.
    effect : str
    widening : float
    prior_odds : float
        Of the effect against its absence.
    probability : float
        That a claim needs.
    """
    column, force, size_unit, name = _column(loops, fitted, effect)
    j = fitted.jacobian / np.maximum(np.linalg.norm(fitted.jacobian, axis=0), 1e-300)
    left = column - j @ np.linalg.lstsq(j, column, rcond=1e-10)[0]
    strength = float(np.linalg.norm(left)) / np.sqrt(widening)
    odds = float(np.log(probability / (1 - probability)) - np.log(prior_odds))
    needed = 2 * odds + float(np.log1p((strength * size_unit) ** 2))
    size = (np.sqrt(max(needed, 0.0)) + MARGIN) / max(strength, 1e-300)
    share = size * force / max(float(np.ptp(loop.force)) / 2 for loop in loops.loops)
    note = {
        "hysteresis": f"at rho = {2 / loops.amplitude_m:.3g} 1/m, sigma = 0.5",
        "relaxation": f"at a relaxation time of {1e3 / loops.omega:.3g} ms",
    }.get(effect, "")
    return Limit(effect, float(size), UNITS[name], float(share), note)


def _column(loops: LoopSet, fitted: Fitted, effect: str) -> tuple[NDArray[np.float64], float, float, str]:
    """Whitened force by a unit of the effect, its largest force, its prior's width and its parameter's name."""
    if effect == "backlash":
        step = _PLAY * loops.least_span_m
        terms = fitted.structure.terms
        without = loops.motion.force(fitted.values, terms)[0]
        change = (loops.motion.force({**fitted.values, GAP: step}, terms)[0] - without) / step
        return loops.whitened(change[:, None])[:, 0], float(np.abs(change).max()), loops.least_span_m, GAP
    name = next(n for n in PARAMETERS[effect].values() if n in LINEAR)
    shape = {n: v * loops.shape_unit(n) for n, v in _TYPICAL.items()}
    plain = loops.motion.column(name, shape)
    return loops.whitened(plain[:, None])[:, 0], float(np.abs(plain).max()), loops.units[name], name


@dataclass(frozen=True)
class Option:
    """A further loop, and by how many standard deviations it would tell two models apart."""

    frequency_hz: float
    amplitude_m: float
    separation: float


def best_loop(loops: LoopSet, true: Fitted, other: Fitted, widening: float) -> Option:
    """The further loop that would tell a model from another one, which is fitted again to all loops with it."""
    frequencies = [loop.frequency_hz for loop in loops.loops]
    amplitudes = [loop.amplitude_m for loop in loops.loops]
    options = []
    for f, a in _TRIED:
        frequency = f * (
            max(frequencies) if f > 1 else min(frequencies) if f < 1 else float(np.median(frequencies))
        )
        amplitude = a * (
            max(amplitudes) if a > 1 else min(amplitudes) if a < 1 else float(np.median(amplitudes))
        )
        more = loops.with_loop(_imagined(loops.loops, true, frequency, amplitude))
        again = fit(more, other.structure, other.values, grid=False)
        rise = max(again.chi2 - other.chi2, 0.0) / widening
        options.append(Option(frequency, amplitude, float(np.sqrt(rise))))
    return max(options, key=lambda o: o.separation)


def _imagined(loops: Sequence[Loop], true: Fitted, frequency_hz: float, amplitude_m: float) -> Loop:
    """The loop that a model gives without noise."""
    phase = (np.arange(256) + 0.5) / 256
    series = np.array([0.0, 0.0, amplitude_m])
    share = float(np.median([loop.force_std_n / np.ptp(loop.force) for loop in loops]))
    blank = Loop(
        name="further loop",
        frequency_hz=frequency_hz,
        amplitude_m=amplitude_m,
        phase=phase,
        series=series,
        displacement=fourier(phase, 1) @ series,
        velocity=fourier_slope(phase, 1) @ series * frequency_hz,
        force=np.zeros(len(phase)),
        force_std_n=1.0,
        cycles=10,
        energy_j=0.0,
        energy_std_j=0.0,
    )
    force, _ = Motion([blank]).force(true.values, true.structure.terms)
    return Loop(**{**vars(blank), "force": force, "force_std_n": share * float(np.ptp(force))})
