"""Diagnosis of an isolator by its force-displacement loops: hypotheses, the next loop, and what else they show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.diagnosis import diagnose
from ema_pipeline.diagnose.hypotheses import Groups, Hypothesis, Name, put_among, size_starts
from ema_pipeline.diagnose.selection import Progress
from ema_pipeline.diagnose.sentences import label_text, size_text, summary
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Diagnosis, Ladder, Localisation
from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.inference import Posterior, descend, learn
from ema_pipeline.loops.compare import loop_fits
from ema_pipeline.loops.sentences import failures
from ema_pipeline.loops.types import LoopModel
from ema_pipeline.mechanics.cycles import Cycles
from ema_pipeline.observations.fitting import Model
from ema_pipeline.observations.loop_data import SAME_FREQUENCY
from ema_pipeline.observations.loop_forces import IsolatorForce, effects_of_loops
from ema_pipeline.observations.loop_regions import regions
from ema_pipeline.observations.loops import LoopObservations, LoopProblem

MOST_EFFECTS = 6
"""Most effects that are added in turn: effects of an isolator act together more often than those of a structure."""
_LISTED = 3
"""Thirds of the cycle that are reported."""
_TRIED = ((0.5, 1.0), (2.0, 1.0), (4.0, 1.0), (1.0, 0.5), (1.0, 1.5))
"""Factors on frequency and amplitude of the further loops that are thought of."""
_POINTS = 128
"""Points of a further loop."""
_TOLD = 2.0
"""Standard deviations by which a further loop would have to tell two models apart."""
_FREE = 0.4
"""Prior 1 σ of the logarithm of a family from which the loops determine it."""


def diagnose_loops(
    observations: LoopObservations,
    library: Mapping[str, Effect],
    known: Model | None = None,
    settings: DiagnoseSettings | None = None,
    progress: Progress = lambda share, text: None,
) -> Diagnosis:
    """Which physics is the isolator's model missing?

    Parameters
    ----------
    observations : LoopObservations
    library : dict of str to Effect
    known : Model, optional
        Effects that the model has already.
    settings : DiagnoseSettings, optional
    progress : callable, optional

    Returns
    -------
    Diagnosis
    """
    settings, known = settings or DiagnoseSettings(), known or Model()
    settings = settings.model_copy(update={"most_effects": MOST_EFFECTS})
    hypotheses = loop_hypotheses(observations, library, known.labels)
    found = diagnose(
        observations, observations.rig, library, known, settings, progress, hypotheses=hypotheses
    )
    if found.verdict == "ambiguous":
        found = _told_apart(observations, library, found, settings)
    last = found.ladder.rungs[-1]
    values = {name: size.value for name, size in last.parameters.items()}
    placed = placed_effects(observations, library, last.effects)
    problem, x = observations.fitted_near(placed, values)
    notes = [*_setting_words(observations, problem, x), *found.notes]
    if found.verdict == "unknown_effect":
        places = regions(problem, x)
        return dataclasses.replace(
            found,
            notes=(*notes, *_missing_words(problem, x, last.error)),
            localisation=tuple(
                Localisation(r.place, r.acts_like, r.size, r.squares) for r in places[:_LISTED]
            ),
            summary=f"{found.summary} Most of the remaining misfit is on the {places[0].place}, and acts there like "
            f"{places[0].acts_like}.",
            next_measurement=_next_loop(observations),
        )
    return dataclasses.replace(found, notes=tuple(notes))


def loop_hypotheses(
    observations: LoopObservations, library: Mapping[str, Effect], known: Iterable[str] = ()
) -> tuple[Hypothesis, ...]:
    """Every effect that changes the loops' force, those of the same force as one hypothesis of several names.

    What acts like a parameter of the rig that is free already is left out.
    """
    skip = set(known)
    problem = observations.problem((), {})
    free = _free_columns(problem)
    groups: Groups = [(column, []) for column in free]
    assembly = observations.rig.assembly(observations.isolator.configuration)
    # the rig's own before generic ones
    own = sorted((e for e in library.values() if not e.records_only), key=lambda e: e.generic)
    for placed in (observations.scaled(PlacedEffect(e, at)) for e in own for at in e.find_places(assembly)):
        if placed.label not in skip and observations.isolator.shows(observations.rig, placed):
            put_among(groups, Name(placed, {}), _change(observations, placed))
    return tuple(
        Hypothesis(tuple(names), begun=size_starts(names[0].placed))
        for k, (_, names) in enumerate(groups)
        if names and k >= len(free)
    )


def _change(observations: LoopObservations, placed: PlacedEffect) -> NDArray[np.float64] | None:
    """Change of the force by one prior 1 σ of the size; None where it is not in proportion to one size."""
    if len(placed.effect.parameters) != 1:
        return None
    p = placed.effect.parameters[0]
    assembly = observations.rig.assembly(observations.isolator.configuration)
    before = observations.cycles.force([e for e, _ in observations.isolator.elements(assembly)])
    found = []
    for share in (0.5, 1.0):
        edited = placed.effect.edit(assembly, placed.place, {p.name: p.null + share * p.scale})
        after = observations.cycles.force([e for e, _ in observations.isolator.elements(edited)])
        found.append((after - before) / share)
    linear = float(np.linalg.norm(found[1] - found[0])) <= 1e-6 * float(np.linalg.norm(found[1]))
    return found[1] if linear else None


def _free_columns(problem: LoopProblem) -> list[NDArray[np.float64]]:
    """Change of the force by every family of the rig that the loops determine."""
    here = problem.force_law.at(np.zeros(problem.offset), 0.0).slopes()
    return [
        here[:, i]
        for i, s in enumerate(problem.model.dependence.unknowns.std)
        if s >= _FREE and np.any(here[:, i])
    ]


def _told_apart(
    observations: LoopObservations,
    library: Mapping[str, Effect],
    found: Diagnosis,
    settings: DiagnoseSettings,
) -> Diagnosis:
    """The diagnosis without rivals that the rest of the model has ruled out or made the same, and the loop that would
    tell the others apart."""
    top = found.ladder.rungs[-1]
    values = {name: size.value for name, size in top.parameters.items()}
    group = found.indistinguishable[0] if found.indistinguishable else ()
    mine = next((label for label in group if label in top.effects), "")
    named = _learned_near(observations, placed_effects(observations, library, top.effects), values)
    left, best = [], Further("", 0.0)
    for rival in (label for label in group if mine and label != mine):
        effects = [rival if label == mine else label for label in top.effects]
        sizes = {c.label: c.parameters for c in found.candidates}.get(rival, {})
        begin = values | {f"{rival}.{n}": s.value for n, s in sizes.items()}
        other = _learned_near(observations, placed_effects(observations, library, effects), begin)
        further = furthest(observations, named, other)
        behind = named.posterior.log_evidence - other.posterior.log_evidence
        if behind < settings.alike and further.separation > _TOLD:
            left.append(rival)
            best = max(best, further, key=lambda f: f.separation)
    if left:
        text = (
            f"A loop {best.text} would distinguish {label_text(mine)} from {label_text(left[0])}: a difference of "
            f"{best.separation:.2g} standard deviations is expected."
        )
        return dataclasses.replace(
            found, next_measurement=text, indistinguishable=((mine, *left), *found.indistinguishable[1:])
        )
    claimed = [(c.label, size_text(c.parameters)) for c in found.candidates if c.label in top.effects]
    errors = (found.ladder.rungs[0].error, top.error)
    return dataclasses.replace(
        found,
        verdict="effect",
        summary=summary("effect", claimed, errors, found.null_probability),
        indistinguishable=found.indistinguishable[1:],
    )


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A model and its posterior."""

    problem: LoopProblem
    posterior: Posterior


def _learned_near(
    observations: LoopObservations, effects: Sequence[PlacedEffect], values: Mapping[str, float]
) -> Fitted:
    """A model fitted from known values, with learned scatters."""
    problem, x = observations.fitted_near(effects, values)
    scatters = {n: s.default for n, s in observations.scatters.items()}
    return Fitted(problem, learn(problem, descend(problem, scatters, x), observations.scatters))


@dataclasses.dataclass(frozen=True)
class Further:
    """A further loop, and by how many standard deviations two models differ in it."""

    text: str
    separation: float


def furthest(observations: LoopObservations, one: Fitted, other: Fitted) -> Further:
    """The further loop in which two models differ most; both keep their parameters."""
    frequencies = [loop.frequency_hz for loop in observations.loops]
    amplitudes = [loop.amplitude_m for loop in observations.loops]
    share = float(np.median([loop.force_std_n / np.ptp(loop.force) for loop in observations.loops]))
    phase = (np.arange(_POINTS) + 0.5) / _POINTS
    found = []
    for f, a in _TRIED:
        frequency, amplitude = _extreme(frequencies, f), _extreme(amplitudes, a)
        cycles = Cycles.of([frequency], [np.array([0.0, 0.0, amplitude])], [phase])
        forces = []
        for fit in (one, other):
            law = IsolatorForce(observations.isolator, fit.problem.model, cycles)
            force = law.at(fit.posterior.x[: fit.problem.offset], 0.0).total
            forces.append(force - np.mean(force))
        std = share * float(np.ptp(forces[0]))
        text = f"at {frequency:.3g} Hz and {1e3 * amplitude:.3g} mm"
        found.append(Further(text, float(np.linalg.norm(forces[0] - forces[1])) / max(std, 1e-300)))
    return max(found, key=lambda one: one.separation)


def _extreme(values: Sequence[float], factor: float) -> float:
    """A factor times the largest or the smallest value, or the middle one where the factor is 1."""
    if factor == 1.0:
        return float(np.median(values))
    return factor * (max(values) if factor > 1.0 else min(values))


def loop_models(
    observations: LoopObservations, library: Mapping[str, Effect], ladder: Ladder
) -> tuple[LoopModel, ...]:
    """The models of a ladder beside the measured loops."""
    found = []
    for rung in ladder.rungs:
        values = {name: size.value for name, size in rung.parameters.items()}
        problem, x = observations.fitted_near(placed_effects(observations, library, rung.effects), values)
        fits = loop_fits(observations.loops, problem.forces(x))
        found.append(LoopModel(rung.effects, fits, problem.force_scales(x)))
    return tuple(found)


def placed_effects(
    observations: LoopObservations, library: Mapping[str, Effect], labels: Sequence[str]
) -> tuple[PlacedEffect, ...]:
    """Effects by their labels, scaled to the loops; EmaError for those that a force loop does not show."""
    found = effects_of_loops(observations.rig, labels, library)
    return tuple(observations.scaled(placed) for placed in found)


def loop_model(observations: LoopObservations, library: Mapping[str, Effect], labels: Sequence[str]) -> Model:
    """The rig with effects ``id@place``; EmaError as in `placed_effects`."""
    return Model(placed_effects(observations, library, labels))


def _setting_words(
    observations: LoopObservations, problem: LoopProblem, x: NDArray[np.float64]
) -> tuple[str, ...]:
    """Which loops stand for other settings of the device."""
    scales = problem.force_scales(x)
    if not scales:
        return ()
    text = ", ".join(f"{name} {scale:.2f}" for name, scale in scales.items())
    ratio = max(scales.values()) / min(scales.values())
    return (
        "loops of one frequency and amplitude differ in force, so they are tests of one device at several "
        f"settings (e.g. tensions): each has a force scale of its own, over a range of 1 : {ratio:.2g} ({text})",
    )


def _missing_words(problem: LoopProblem, x: NDArray[np.float64], error: float) -> list[str]:
    """What the best model does not show."""
    o = problem.observations
    fits = loop_fits(o.loops, problem.forces(x))
    play = any(e.effect.id == "backlash" for e in problem.model.effects)
    words = failures(o.loops, fits, fits, error, has_play=play, own_scales=o.own_scales)
    return [f"still missing: {text}" for text in words]


def _next_loop(observations: LoopObservations) -> str:
    """What to record where no model explains the loops."""
    frequencies = [loop.frequency_hz for loop in observations.loops]
    if max(frequencies) < (1 + SAME_FREQUENCY) * min(frequencies):
        return (
            f"Repeat the loops at {0.5 * min(frequencies):.3g} and at {2 * max(frequencies):.3g} Hz: what stays "
            "is friction or play, what changes depends on the rate. Ten cycles or more of each loop would "
            "distinguish scatter from what repeats."
        )
    return (
        "Repeat one loop about another mean position, and record ten cycles or more of each: what moves with "
        "the position is geometry, what stays is the material."
    )
