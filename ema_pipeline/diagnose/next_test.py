"""What to measure next: the further sensor or added mass that tells two explanations apart best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.claims import Judged
from ema_pipeline.diagnose.selection import Selection
from ema_pipeline.diagnose.sentences import label_text
from ema_pipeline.diagnose.types import NOTHING, VerdictWord
from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.eigen_derivatives import EigenSolution
from ema_pipeline.mechanics.system import LinearSystem, sensor_row
from ema_pipeline.number_text import prefixed
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit
from ema_pipeline.observations.mode_rows import FREQUENCY, SHAPE
from ema_pipeline.observations.modes import ModeObservations

_ADDED_SHARE = 0.1
"""Mass that is added for a further test, as a share of the body's own."""
_LEAST_SHAPE_STD = 0.02
_LEAST_FREQUENCY_STD = 1e-3
_WORTH = 1.0
"""Difference, in standard deviations, below which a measurement is not worth proposing."""
_CERTAIN = 0.9
Systems = tuple[LinearSystem, ...]


@dataclass(frozen=True)
class Option:
    """A measurement and by how many standard deviations two models differ in it."""

    text: str
    separation: float


def next_measurement(
    observations: Observations, found: Selection, group: Sequence[Judged], verdict: VerdictWord
) -> str:
    """The measurement that would help most, in a sentence; empty where nothing is needed."""
    if verdict == "unknown_effect":
        return _beyond_the_library(observations)
    if verdict == "ambiguous" and len(group) > 1:
        first, second = group[0].ranked.fit, group[1].ranked.fit
        names = (label_text(group[0].named.label), label_text(group[1].named.label))
    elif (
        verdict == "adequate" and found.rounds[0].probabilities[NOTHING] < _CERTAIN and found.rounds[0].judged
    ):
        best = found.rounds[0].judged[0]
        first, second = best.ranked.fit, found.rounds[0].ranking.base
        names = (label_text(best.named.label), "nothing missing")
    else:
        return ""
    if not isinstance(observations, ModeObservations):
        return ""
    options = _options(observations, first, second)
    if not options or options[0].separation < _WORTH:
        if verdict == "adequate":
            return ""
        return f"No single further measurement that was tried would distinguish {names[0]} from {names[1]}."
    best_option = options[0]
    return (
        f"{best_option.text} would distinguish {names[0]} from {names[1]}: a difference of "
        f"{best_option.separation:.1f} standard deviations is expected."
    )


def _beyond_the_library(observations: Observations) -> str:
    """What helps where nothing explains the data; a value of the rig file that is wrong looks like that too."""
    further = sensors = "put further sensors where measurement and model differ most"
    if not observations.linearised:
        moves = "if a natural frequency moves, the missing effect depends on amplitude"
        further = f"hit at three force levels: {moves}; if not, {sensors}"
    elif observations.level_dependent:
        further = (
            "hit more softly, until no mode moves with the force: what is missing beside that shows there"
        )
    return f"Check values and units in the rig file; if they are right, {further}."


def _options(observations: ModeObservations, first: Fit, second: Fit) -> list[Option]:
    """All measurements that were tried, best first."""
    models = [observations.problem(f.model.effects, f.model.scales).model for f in (first, second)]
    options = []
    for data in observations.data:
        systems = tuple(
            m.system(data.configuration, f.posterior.x[: len(m.unknowns)])
            for m, f in zip(models, (first, second), strict=True)
        )
        measured = {d.point for d in data.dofs}
        shape_std = max(first.posterior.scatters[SHAPE], _LEAST_SHAPE_STD)
        for place in (*systems[0].dofs, *systems[0].sensors):
            if place in measured or place not in (*systems[1].dofs, *systems[1].sensors):
                continue
            gap = _shape_gap(systems, data.band_hz, place) / shape_std
            options.append(Option(f"A sensor at {place} ({data.configuration})", gap))
        frequency_std = max(first.posterior.scatters[FREQUENCY], _LEAST_FREQUENCY_STD)
        for i, dof in enumerate(systems[0].dofs):
            if dof in systems[1].dofs and not dof.endswith(".u"):
                mass = _ADDED_SHARE * float(systems[0].mass[i, i])
                gap = _frequency_gap(systems, data.band_hz, dof, mass) / frequency_std
                scale, unit = prefixed(mass, "kg")
                text = f"A mass of {scale * mass:.2g} {unit} added at {dof} ({data.configuration})"
                options.append(Option(text, gap))
    return sorted(options, key=lambda o: -o.separation)


def _solved(system: LinearSystem, extra: tuple[str, float] | None = None) -> EigenSolution | None:
    mass = system.mass.copy()
    if extra is not None:
        i = system.dofs.index(extra[0])
        mass[i, i] += extra[1]
    dense = np.stack([mass, system.damping, system.stiffness, system.structural])
    return EigenSolution.of(dense, np.zeros_like(mass), system.modal_damping_ratio)


def _within(solution: EigenSolution, band: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((solution.frequency_hz > band[0]) & (solution.frequency_hz < band[1]))


def _shape_gap(systems: Systems, band: tuple[float, float], place: str) -> float:
    """Root sum of squares of the difference of the shapes at a place, relative to each shape's largest entry."""
    read = []
    for system in systems:
        solution = _solved(system)
        if solution is None:
            return 0.0
        on = _within(solution, band)
        row = sensor_row(system, Dof.parse(place))
        shapes = solution.shapes[:, on]
        read.append(np.abs(row @ shapes) / np.max(np.abs(shapes), axis=0))
    count = min(len(r) for r in read)
    return float(np.linalg.norm(read[0][:count] - read[1][:count]))


def _frequency_gap(systems: Systems, band: tuple[float, float], dof: str, mass: float) -> float:
    """Root sum of squares of the difference of the shifts of ln f that an added mass brings."""
    shifts = []
    for system in systems:
        before, after = _solved(system), _solved(system, (dof, mass))
        if before is None or after is None:
            return 0.0
        on = _within(before, band)
        shifts.append(np.log(after.frequency_hz[on]) - np.log(before.frequency_hz[on]))
    count = min(len(s) for s in shifts)
    return float(np.linalg.norm(shifts[0][:count] - shifts[1][:count]))
