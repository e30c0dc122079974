"""Diagnosis by simulation of continuous records: hypotheses, the search on windows, the ladder on whole records."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.diagnosis import diagnose
from ema_pipeline.diagnose.hypotheses import Groups, Hypothesis, Name, put_among, size_starts
from ema_pipeline.diagnose.probability import CLOSEST, shared
from ema_pipeline.diagnose.rungs import (
    learned_scatters,
    make_ladder,
    noise,
    parameter_sizes,
    rung_at,
    with_gains,
)
from ema_pipeline.diagnose.selection import Progress
from ema_pipeline.diagnose.sentences import label_text, size_text, summary
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import NOTHING, Candidate, Diagnosis, Ladder, Rung, VerdictWord
from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.effects.library import parse_effect
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.driven_system import coded_law
from ema_pipeline.mechanics.simulation import COARSE
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.observations.base import EffectProblem
from ema_pipeline.observations.fitting import Fit, Model, learned, refined
from ema_pipeline.observations.records import RecordObservations
from ema_pipeline.processes import spread

SEARCHED = 2048
"""Samples of all responses together, in windows, on which hypotheses are compared: enough to give gains of hundreds
in log evidence, quick enough for all."""
_SETTLED = 4 * SEARCHED
"""The same for sizes that are told of windows: a third of a short record gave one that was five standard deviations
off."""
_LOST = 3.0
"""Error in whole records, over that in windows, from which a simulation has drifted out of phase with the measured
motion."""
_OF_OTHERS = 0.02
"""Share of the log evidence of earlier claims that a further one must gain: what the form of a law leaves of the
motion, friction that sticks and slips for one, looks like another effect."""
_FURTHER_FINALISTS = 3
"""Finalists beside those that lead at wide scatters: noise of a tenth, with which fits begin, hides most of a small
effect that is plain at the noise that the records have."""
_PREDICTED_BETTER = 1e-3
"""Share of the error of held-out records that a claim must take away."""
_SAME_CHANGE = 1e-5
"""Relative difference of two changes of the linear system below which they are the same physics."""
_TRIAL = 1e-6
"""Change of a logarithm by which a matrix is differentiated."""
_OUT_OF_PHASE = (
    "the model is fitted to windows of a few cycles; over whole records the simulation drifts out of phase"
)


def diagnose_records(
    observations: RecordObservations,
    library: Mapping[str, Effect],
    known: Sequence[str] = (),
    settings: DiagnoseSettings | None = None,
    progress: Progress = lambda share, text: None,
    notes: Sequence[str] = (),
) -> Diagnosis:
    """Which physics is the model missing?

    Parameters
    ----------
    observations : RecordObservations
    library : dict of str to Effect
    known : sequence of str
        Effects ``id@place`` that the model has already.
    settings : DiagnoseSettings, optional
    progress : callable, optional
    notes : sequence of str
        Remarks on the data.

    Returns
    -------
    Diagnosis
        Its search used windows of the records; its ladder holds the whole ones, where the model can follow them.
    """
    settings = settings or DiagnoseSettings()
    further = max(settings.further_finalists, _FURTHER_FINALISTS)
    settings = settings.model_copy(update={"further_finalists": further})
    windows = in_windows(observations)
    hypotheses = record_hypotheses(observations, library, known)
    found = diagnose(
        windows,
        observations.rig,
        library,
        record_model(observations, library, known),
        settings,
        lambda share, text: progress(0.85 * share, text),
        notes,
        hypotheses=hypotheses,
    )
    progress(0.85, "whole records")
    searched = found.ladder
    ladder = whole_ladder(observations, library, searched, settings.processes)
    while doubt := _unconfirmed(observations, found, ladder, settings):
        lost = max(0.0, _claimed(found)[-1].log_evidence - _last_gain(ladder))
        found, searched = _withdrawn(found, searched, doubt, lost)
        ladder = whole_ladder(observations, library, searched, settings.processes)
    return _with_whole(found, ladder)


def _unconfirmed(
    observations: RecordObservations, found: Diagnosis, ladder: Ladder, settings: DiagnoseSettings
) -> str:
    """Why whole records do not support the last claim; empty where they do, or carry no information on it.

    Windows take coarser steps, and states of their own, which an effect too many may make up for.
    """
    if len(ladder.rungs) < 2 or _OUT_OF_PHASE in ladder.note:
        return ""
    gain = _last_gain(ladder)
    if gain < settings.claim:
        return f"its gain in log evidence over whole records, {gain:.1f}, is below {settings.claim:g}"
    held = [r.heldout_error for r in ladder.rungs[-2:]]
    if observations.held_out and not held[1] < (1 - _PREDICTED_BETTER) * held[0]:
        return "it does not predict held-out records better"
    *before, last = (c.log_evidence for c in _claimed(found))
    if last < _OF_OTHERS * sum(before):
        return (
            f"its gain in log evidence, {last:.1f}, is below {100 * _OF_OTHERS:g} % of that of the other effects, "
            "whose laws are not known more exactly"
        )
    return ""


def _last_gain(ladder: Ladder) -> float:
    return ladder.rungs[-1].log_evidence - ladder.rungs[-2].log_evidence


def _claimed(found: Diagnosis) -> list[Candidate]:
    return [c for c in found.candidates if c.claimed]


def _withdrawn(found: Diagnosis, searched: Ladder, doubt: str, lost: float) -> tuple[Diagnosis, Ladder]:
    """Diagnosis and ladder of the search without the last claim."""
    label = searched.rungs[-1].effects[-1]
    candidates = tuple(
        dataclasses.replace(c, claimed=False, why=f"Not claimed: {doubt}.") if c.label == label else c
        for c in found.candidates
    )
    groups = tuple(g for g in found.indistinguishable if label not in g)
    note = f"the best further effect is {label_text(label)}, and {doubt}"
    rungs = searched.rungs[:-1]
    verdict = found.verdict
    if verdict == "ambiguous" and label in found.indistinguishable[0]:  # the group of which one was claimed
        verdict = "effect"
    kept = dataclasses.replace(found, verdict=verdict, candidates=candidates, indistinguishable=groups)
    if len(rungs) == 1:
        kept = _nothing_claimed(kept, rungs[0].error, lost)
    return kept, dataclasses.replace(searched, rungs=rungs, note=note)


def _nothing_claimed(found: Diagnosis, error: float, lost: float) -> Diagnosis:
    """Verdict and probabilities where whole records take back the only claim, by `lost` in log evidence."""
    told = {n: p if n == NOTHING else p * float(np.exp(-lost)) for n, p in found.probabilities.items()}
    total = sum(told.values())
    told = {n: p / total for n, p in told.items()}
    verdict: VerdictWord = "adequate" if error <= found.error_limit else "unknown_effect"
    if verdict == "unknown_effect":
        told = shared(told, CLOSEST, 0.0)
    return dataclasses.replace(
        found,
        verdict=verdict,
        summary=summary(verdict, (), (error, error), told[NOTHING]),
        candidates=tuple(
            dataclasses.replace(c, probability=told.get(c.label, c.probability)) for c in found.candidates
        ),
        probabilities=told,
        null_probability=told[NOTHING],
    )


def in_windows(observations: RecordObservations) -> RecordObservations:
    """The same test by windows of its records, with coarser steps, and what free values absorb left out."""
    windows = observations.in_windows(SEARCHED)
    return observations.with_records(windows.data, windows.held_out, observations.basis.calibrated(), COARSE)


def record_model(
    observations: RecordObservations, library: Mapping[str, Effect], labels: Iterable[str]
) -> Model:
    """The rig with effects ``id@place``; EmaError for effects and places that do not exist."""
    rig, configuration = observations.basis.rig, observations.configuration
    return Model(
        tuple(observations.scaled(parse_effect(label, rig, configuration, library)) for label in labels)
    )


def record_hypotheses(
    observations: RecordObservations, library: Mapping[str, Effect], known: Iterable[str] = ()
) -> tuple[Hypothesis, ...]:
    """The generic effects, and the user's own, at every DOF and between any two bodies.

    An effect that changes the linear system like a free rig parameter is left out.
    """
    skip = set(known)
    assembly = observations.basis.rig.assembly(observations.configuration)
    # sought at every DOF and between any two bodies; what is simplest to say comes first
    anywhere = [e for e in library.values() if e.generic or e.records_order is not None]
    anywhere.sort(key=lambda e: (e.records_order is None, e.records_order or 0, e.id))
    ids = {e.id for e in anywhere}
    own = [] if observations.modal else [e for e in library.values() if e.id not in ids]
    placed = [PlacedEffect(e, place) for e in own for place in e.find_places(assembly)]
    for place in _places(observations):
        for effect in (e.at(assembly, place) for e in anywhere):
            if effect.fits(assembly, place) and not (observations.modal and effect.linear):
                placed.append(PlacedEffect(effect, place))
    loose = _loose_columns(observations)
    groups: Groups = []
    for one in placed:
        if one.label in skip or not _can_be_simulated(observations, one):
            continue
        scaled = observations.scaled(one)
        change = _linear_change(observations, scaled)
        if change is None or not _spanned(change, loose):
            put_among(groups, Name(scaled, {}), change, 1 - _SAME_CHANGE)
    return tuple(Hypothesis(tuple(names), begun=size_starts(names[0].placed)) for _, names in groups)


def _places(observations: RecordObservations) -> tuple[str, ...]:
    """Measured DOFs, other DOFs, and pairs of bodies that elements join or that share a direction."""
    assembly = observations.basis.rig.assembly(observations.configuration)
    measured = [d.point for d in observations.basis.outputs]
    if observations.modal:
        return tuple(dict.fromkeys(measured))
    dofs = tuple(dict.fromkeys([*measured, *assembly.dofs]))
    pairs = (
        f"{a}-{b}"
        for a, b in combinations(assembly.bodies, 2)
        if {d.rpartition(".")[2] for d in assembly.coordinates(a)}
        & {d.rpartition(".")[2] for d in assembly.coordinates(b)}
    )
    return (*dofs, *pairs)


def whole_ladder(
    observations: RecordObservations,
    library: Mapping[str, Effect],
    searched: Ladder,
    processes: int | None = 1,
) -> Ladder:
    """The rungs of a ladder that was found on windows, fitted to whole records, shared among processes.

    Where motion depends so much on its start that the model drifts out of phase in them, the rungs are fitted to more
    windows than the search used.
    """
    whole = _refitted(observations, library, searched, processes)
    limit = _LOST * max(searched.rungs[-1].error, 1.0)
    if whole.rungs[-1].error < limit:
        return whole
    windows = _refitted(observations.in_windows(_SETTLED), library, searched, processes)
    told = searched.note  # of a diagnosis, whose ladder may have come this way before
    if _OUT_OF_PHASE not in told:
        told = f"{told}; {_OUT_OF_PHASE}" if told else _OUT_OF_PHASE
    return dataclasses.replace(windows, note=told)


def _refitted(
    observations: RecordObservations, library: Mapping[str, Effect], searched: Ladder, processes: int | None
) -> Ladder:
    """The rungs fitted to whole records, or to windows of them.

    The fit takes its reference channels as exact, which costs nothing. Uncertainties are those with all calibrations.
    """
    scatters = {s.name: s.learned for s in searched.scatters}
    records = [d if d.windowed else d.record for d in observations.data]
    fast = observations.with_records(records, observations.held_out, observations.basis.calibrated())

    def begun(rung: Rung) -> Fit:
        model = record_model(observations, library, rung.effects)
        return refined(fast, model, begun_at(model.problem(fast), rung), scatters, steps=0)

    last = learned(fast, begun(searched.rungs[-1]))
    narrow = last.posterior.scatters

    def fitted(rung: Rung) -> Rung:
        fit = last if rung is searched.rungs[-1] else begun(rung)
        return _with_calibration(observations, library, rung_at(fast, fit, narrow), narrow)

    rungs = with_gains(list(spread(fitted, searched.rungs, processes, least=2)))
    return Ladder(rungs, *noise(last), searched.note, scatters=learned_scatters(fast, last))


def begun_at(problem: EffectProblem, rung: Rung) -> NDArray[np.float64]:
    """Unknowns of a problem as a rung has them, those that it has not at their start."""
    x = problem.start()
    for name, value in rung.unknowns.items():
        if name in problem.unknowns.index:
            x[problem.unknowns.index[name]] = value
    return x


def _with_calibration(
    observations: RecordObservations,
    library: Mapping[str, Effect],
    rung: Rung,
    scatters: Mapping[str, float],
) -> Rung:
    """A rung whose sizes hold what all channels' calibration leaves open."""
    model = record_model(observations, library, rung.effects)
    problem = model.problem(observations)
    posterior = refined(observations, model, begun_at(problem, rung), scatters, steps=0).posterior
    sizes = parameter_sizes(problem, posterior)
    units = _units(observations)
    found = {n: dataclasses.replace(s, unit=s.unit or units.get(n, "")) for n, s in sizes.items()}
    return dataclasses.replace(rung, parameters=found)


def records_ladder(
    observations: RecordObservations,
    library: Mapping[str, Effect],
    effects: Sequence[str],
    known: Ladder | None,
    processes: int | None = 1,
) -> Ladder:
    """The ladder of given effects, fitted on windows where `known` does not hold just these, then on whole records."""
    rungs = () if known is None else known.rungs
    if known is None or not rungs or rungs[-1].effects != tuple(effects):
        models = [record_model(observations, library, effects[:k]) for k in range(len(effects) + 1)]
        known = make_ladder(in_windows(observations), models)
    return whole_ladder(observations, library, known, processes)


def _units(observations: RecordObservations) -> dict[str, str]:
    """Units of the rig's own values."""
    stated = {name: unit for name, (_, unit) in observations.linear_model.stated.items()}
    return {name: p.unit for name, p in observations.basis.rig.parameters.items()} | stated


def _with_whole(found: Diagnosis, ladder: Ladder) -> Diagnosis:
    """The diagnosis with the sizes and errors of whole records."""
    last = ladder.rungs[-1]
    candidates = tuple(_with_sizes(c, last) for c in found.candidates)
    told = [(c.label, size_text(c.parameters)) for c in candidates if c.claimed]
    first = ladder.rungs[0]
    words = found.summary
    if found.verdict in ("effect", "adequate"):
        words = summary(found.verdict, told, (first.error, last.error), found.adequate_probability)
    return dataclasses.replace(
        found,
        candidates=candidates,
        ladder=ladder,
        summary=words,
        error=first.error,
        heldout_error=first.heldout_error,
    )


def _with_sizes(candidate: Candidate, rung: Rung) -> Candidate:
    if candidate.label not in rung.effects:
        return candidate
    sizes = {n: rung.parameters.get(f"{candidate.label}.{n}", s) for n, s in candidate.parameters.items()}
    return dataclasses.replace(candidate, parameters=sizes)


def _linear_change(observations: RecordObservations, placed: PlacedEffect) -> NDArray[np.float64] | None:
    """Change of the linear system by one prior 1 σ of the only size; None for effects that are not linear."""
    if len(placed.effect.parameters) != 1 or not placed.effect.linear:
        return None
    p = placed.effect.parameters[0]
    assembly = observations.basis.rig.assembly(observations.configuration)
    edited = placed.effect.edit(assembly, placed.place, {p.name: p.null + p.scale})
    return _matrices(observations, edited.system()) - _matrices(observations, assembly.system())


def _loose_columns(observations: RecordObservations) -> NDArray[np.float64]:
    """Changes of the linear system by the values that the records determine anyway, (3·n·n, n_loose)."""
    model = observations.linear_model.rig_model
    zero = np.zeros(len(model.unknowns))
    before = model.system(observations.configuration, zero)
    found = []
    for name in observations.basis.loose:
        x = zero.copy()
        x[model.unknowns.index[name]] = _TRIAL
        change = _matrices(observations, model.system(observations.configuration, x))
        found.append((change - _matrices(observations, before)) / _TRIAL)
    n = len(before.mass)
    if model.has_ratio and n == 1:  # one coordinate: a damper and a damping ratio are the same
        found.append(np.array([0.0, 1.0, 0.0]))
    return np.array(found).reshape(-1, 3 * n * n).T


def _matrices(observations: RecordObservations, system: LinearSystem) -> NDArray[np.float64]:
    """Mass, damping and stiffness in units of the rig's own, (3·n·n,)."""
    whole = observations.basis.rig.system(observations.configuration)
    stiffness = float(np.max(np.abs(whole.stiffness))) or 1.0
    mass = float(np.max(np.abs(whole.mass)))
    damping = np.sqrt(stiffness * mass)
    parts = (system.mass / mass, system.damping / damping, system.stiffness / stiffness)
    return np.concatenate([m.ravel() for m in parts])


def _can_be_simulated(observations: RecordObservations, placed: PlacedEffect) -> bool:
    """True for an effect that leaves the coordinates as they are and has a response in time."""
    assembly = observations.basis.rig.assembly(observations.configuration)
    edited = placed.effect.edit(assembly, placed.place, {p.name: p.start for p in placed.effect.parameters})
    if edited.dofs != assembly.dofs or np.any(edited.system().structural):
        return False
    try:
        for element in edited.nonlinear:
            coded_law(element)
    except EmaError:
        return False
    return True


def _spanned(change: NDArray[np.float64], loose: NDArray[np.float64]) -> bool:
    """True where free values of the rig make the same change together."""
    if not np.any(change):
        return True
    factors = np.linalg.lstsq(loose, change, rcond=1e-12)[0]
    return float(np.linalg.norm(change - loose @ factors)) < _SAME_CHANGE * float(np.linalg.norm(change))
