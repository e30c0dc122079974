"""What records show of a Bouc-Wen element: its loop, the energy of a cycle, and the parameters that they determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.records import begun_at, record_model
from ema_pipeline.diagnose.types import Ladder
from ema_pipeline.effects.base import Effect
from ema_pipeline.mechanics.dissipation import HystereticSpring
from ema_pipeline.observations.base import EffectProblem
from ema_pipeline.observations.fitting import refined
from ema_pipeline.observations.records import RecordObservations

_POINTS = 256
_CYCLES = 6
"""Cycles after which the loop closes."""
_STEP = 1e-4
_NAMES = ("stiffness", "force", "shape", "exponent")


@dataclass(frozen=True)
class HysteresisLoop:
    """One element's loop at the amplitude of the records, √2 times the root mean square of its stretch.

    Attributes
    ----------
    label : str
        ``hysteresis@place``.
    amplitude_m : float
    displacement, force : ndarray, (n_points,)
        One closed cycle, m and N.
    force_std : ndarray, (n_points,)
        1 σ of the force.
    energy_j, energy_std_j : float
        Lost per cycle.
    stiffness_n_m, stiffness_std_n_m : float
        Of the line through the loop's tips.
    best, worst : tuple of (dict of str to float, float)
        Combinations of relative changes of the parameters that the records tell best and worst, and 1 σ of each.
    """

    label: str
    amplitude_m: float
    displacement: NDArray[np.float64]
    force: NDArray[np.float64]
    force_std: NDArray[np.float64]
    energy_j: float
    energy_std_j: float
    stiffness_n_m: float
    stiffness_std_n_m: float
    best: tuple[dict[str, float], float]
    worst: tuple[dict[str, float], float]


def hysteresis_loops(
    observations: RecordObservations, library: Mapping[str, Effect], ladder: Ladder
) -> tuple[HysteresisLoop, ...]:
    """Loops of all Bouc-Wen elements of the ladder's last model."""
    rung = ladder.rungs[-1]
    labels = [x for x in rung.effects if x.startswith("hysteresis@")]
    if not labels:
        return ()
    model = record_model(observations, library, rung.effects)
    problem = model.problem(observations)
    scatters = {s.name: s.learned for s in ladder.scatters}
    posterior = refined(observations, model, begun_at(problem, rung), scatters, steps=0).posterior
    found = []
    for label in labels:
        names = [f"{label}.{n}" for n in _NAMES]
        at = [problem.unknowns.index[n] for n in names]
        amplitude = observations.typical(label.partition("@")[2]).amplitude_m

        def loop(
            x: NDArray[np.float64], names: list[str] = names, amplitude: float = amplitude
        ) -> NDArray[np.float64]:
            values = problem.parameter_values(x)
            return _cycle(amplitude, [values[n] for n in names])

        force = loop(posterior.x)
        slopes = np.empty((len(at), len(force)))
        for k, i in enumerate(at):
            moved = posterior.x.copy()
            moved[i] += _STEP
            slopes[k] = (loop(moved) - force) / _STEP
        covariance = posterior.covariance[np.ix_(at, at)]
        stretch = _path(amplitude)
        weight = _work(stretch)
        tips = np.zeros(len(force))
        tips[[int(np.argmax(stretch)), int(np.argmin(stretch))]] = 0.5 / amplitude, -0.5 / amplitude
        best, worst = _combinations(problem, posterior.x, names, at, covariance)
        found.append(
            HysteresisLoop(
                label,
                amplitude,
                stretch,
                force,
                np.sqrt(np.einsum("kp,kl,lp->p", slopes, covariance, slopes)),
                float(weight @ force),
                _std(slopes @ weight, covariance),
                float(tips @ force),
                _std(slopes @ tips, covariance),
                best,
                worst,
            )
        )
    return tuple(found)


def _path(amplitude: float) -> NDArray[np.float64]:
    return amplitude * np.sin(2 * np.pi * np.arange(_POINTS) / _POINTS)


def _cycle(amplitude: float, values: list[float]) -> NDArray[np.float64]:
    """Force along the last of several cycles, its mean left out, N."""
    element = HystereticSpring("loop", {"x": 1.0}, *values)
    path = np.tile(_path(amplitude), _CYCLES)
    force = element.along(path, np.zeros_like(path), 1.0, 0.0, 0.0) + element.stiffness * path
    last = force[-_POINTS:]
    return np.asarray(last - np.mean(last))


def _work(stretch: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the force in the energy of a cycle, ∮F dx, by the trapezoidal rule."""
    return np.asarray(0.5 * (np.roll(stretch, -1) - np.roll(stretch, 1)))


def _std(slope: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    return float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))


Combination = tuple[dict[str, float], float]


def _combinations(
    problem: EffectProblem,
    x: NDArray[np.float64],
    names: Sequence[str],
    at: Sequence[int],
    covariance: NDArray[np.float64],
) -> tuple[Combination, Combination]:
    """Eigenvectors of the covariance of relative changes of the parameters, the least and the most uncertain."""
    values = problem.parameter_values(x)
    sizes = problem.sizes
    pairs = zip(names, at, strict=True)
    relative = np.array([sizes[n].slope(float(x[i])) / max(abs(values[n]), 1e-300) for n, i in pairs])
    squares, vectors = np.linalg.eigh(relative[:, None] * covariance * relative)
    told = []
    for k in (0, -1):
        told.append(
            (
                dict(zip(_NAMES, (float(v) for v in vectors[:, k]), strict=True)),
                float(np.sqrt(max(squares[k], 0.0))),
            )
        )
    return told[0], told[1]
