"""Which physical effect is the model missing? The whole diagnosis, from measured modes to a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.explain import label_text, size_text, why
from ema_pipeline.diagnose.fitting import Case, Fitted, fit_null, holds, refit
from ema_pipeline.diagnose.heldout import held_out
from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, describe, extras, single_hypotheses
from ema_pipeline.diagnose.ladder import Yardstick, assemble_ladder, noise_of, yardstick
from ema_pipeline.diagnose.localise import localise
from ema_pipeline.diagnose.noise import NoiseLevel, floors
from ema_pipeline.diagnose.ranking import Ranking, rank, sharpen
from ema_pipeline.diagnose.screening import Screening, screen
from ema_pipeline.diagnose.separate import best_measurement
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.thresholds import threshold
from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder, Localisation, VerdictWord
from ema_pipeline.effects.library import Library
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.rigs.types import Rig
from ema_pipeline.threads import single_blas_thread

Progress = Callable[[float, str], None]

_SPURIOUS = 2
"""Well-determined modes without counterpart that may still be of the foundation, or spurious."""


def diagnose(
    rig: Rig,
    measured: Mapping[str, MeasuredModes],
    settings: DiagnoseSettings | None = None,
    library: Library | None = None,
    progress: Progress | None = None,
    warnings: Sequence[str] = (),
    thresholds: Mapping[str, float] | None = None,
) -> Diagnosis:
    """Find the physics that a rig's model is missing.

    Parameters
    ----------
    rig : Rig
        The base model.
    measured : mapping of configuration to MeasuredModes
    settings : DiagnoseSettings, optional
    library : mapping of id to Effect, optional
        The shipped effects where left out; see `effects.library.effect_library` for the user's own.
    progress : callable, optional
        Called with the share done (0…1) and a word on what is being done.
    warnings : sequence of str
        Remarks of earlier stages that the reader of a diagnosis should see (checks that failed).
    thresholds : mapping of family to gain, optional
        Calibrated thresholds in place of the shipped ones, see `diagnose.thresholds`.

    Returns
    -------
    Diagnosis
        Deterministic: the same data and settings give the same answer.

    Raises
    ------
    EmaError
        If there are no measured modes, or the rig has nothing to fit.

    Notes
    -----
    Every hypothesis (an effect at a place, or a parameter out of its tolerance) is fitted with all parameters of
    the rig; the base model is fitted again from each hypothesis' parameters. Then the noise level is taken from
    the best hypothesis and all is fitted again. Evidence is Laplace's, with the priors that the tolerances and
    the effects' scales state.
    """
    settings = settings or DiagnoseSettings()
    tell = progress or (lambda share, text: None)
    screening = screen(rig, measured)
    case = Case(rig, screening.measured, settings, library)
    with single_blas_thread():
        return _diagnose(case, screening, tuple(warnings), thresholds, tell)


@dataclass(frozen=True)
class _Climb:
    """Models of the ladder and the rankings on top of each."""

    models: list[Fitted]
    rankings: list[Ranking]
    level: NoiseLevel
    note: str


def _diagnose(
    case: Case,
    screening: Screening,
    warnings: tuple[str, ...],
    thresholds: Mapping[str, float] | None,
    tell: Progress,
) -> Diagnosis:
    climbed = _climb(case, thresholds, tell)
    first = climbed.rankings[0]
    ladder = assemble_ladder(
        case, climbed.models, climbed.level, climbed.note, _part(tell, 0.85, 0.95), first.fitted
    )
    stick = yardstick(case, climbed.level.applied(case.settings.fit), [*climbed.models, *first.fitted])
    members = _group(case, first)
    candidates = _candidates(case, first, members, climbed, ladder, stick, thresholds)
    if len(climbed.models) == 1:
        mending = [f for f in members if _mends(case, f, stick)]
        members = mending or members[:1]
    verdict, summary = _verdict(case, screening, climbed, members, ladder, stick)
    tell(0.97, "next measurement")
    groups = (tuple(f.hypothesis.label for f in members),) if verdict == "ambiguous" else ()
    localised: tuple[Localisation, ...] = ()
    if verdict == "unknown_effect":
        top = climbed.models[-1]
        localised = localise(case, top.hypothesis, stick.fit, top.values)
        summary += _where(localised)
    tell(1.0, "done")
    return Diagnosis(
        verdict=verdict,
        summary=summary,
        null_probability=first.probabilities[NOTHING],
        candidates=candidates,
        indistinguishable=groups,
        next_measurement=_next(case, verdict, first, members, stick),
        localisation=localised,
        probabilities=first.probabilities,
        error=ladder.rungs[0].error,
        heldout_error=ladder.rungs[0].heldout_error,
        ladder=ladder,
        notes=(*screening.notes, *_unexplained_notes(case, climbed, stick), *warnings),
    )


def _climb(case: Case, thresholds: Mapping[str, float] | None, tell: Progress) -> _Climb:
    """Rank all hypotheses on the base model, add what is claimed, and rank again on top of it."""
    settings = case.settings
    configurations = list(case.measured)
    tell(0.0, "base model")
    base = fit_null(case, Hypothesis(), settings.fit, None)
    hypotheses = single_hypotheses(case.rig, configurations, case.library)
    if holds(base):
        # The base model itself tells the noise level; one round is enough unless a hypothesis leaves less.
        level = noise_of(case, base)
        base = fit_null(case, Hypothesis(), level.applied(settings.fit), base.values)
        ranking = rank(case, base, hypotheses, level.applied(settings.fit), _part(tell, 0.05, 0.5))
        first = ranking.base
    else:
        ranking = rank(case, base, hypotheses, settings.fit, _part(tell, 0.05, 0.5))
        first, level = ranking.base, floors(settings.fit)
    best = min((ranking.base, *ranking.fitted), key=lambda f: f.evidence)
    finer = noise_of(case, best)
    if finer.below(level):
        level = finer
        fit = level.applied(settings.fit)
        base = refit(case, Hypothesis(), fit, first.values)
        ranking = sharpen(case, ranking, base, fit, _part(tell, 0.55, 0.7))
    fit = level.applied(settings.fit)
    models, rankings = [ranking.base], [ranking]
    note = ""
    while True:
        top = _claimable(case, rankings[-1], fit, thresholds)
        if top is None:
            note = "no further effect is supported by the data"
            break
        if len(models) > settings.most_rungs:
            note = f"stopped after {settings.most_rungs} effects"
            break
        models.append(top)
        rest = single_hypotheses(case.rig, configurations, case.library, top.hypothesis)
        tell(0.72, f"on top of {top.hypothesis.label}")
        rankings.append(rank(case, top, rest, fit, _part(tell, 0.72, 0.85)))
        models[-1] = rankings[-1].base
    return _Climb(models, rankings, level, note)


def _claimable(
    case: Case, ranking: Ranking, fit: FitSettings, thresholds: Mapping[str, float] | None
) -> Fitted | None:
    """The most probable hypothesis where something is missing for sure and held-out data agree."""
    settings = case.settings
    if 1 - ranking.probabilities[NOTHING] < settings.probability_least or not ranking.fitted:
        return None
    top = ranking.ordered()[0]
    if ranking.gain(top) < threshold(top.hypothesis.family, settings.gain_least, thresholds):
        return None
    stick = yardstick(case, fit, [ranking.base, *ranking.fitted])
    before, after = (
        stick.heldout_error(f, held_out(case, f, fit, settings.folds)) for f in (ranking.base, top)
    )
    return top if after < before else None


def _group(case: Case, ranking: Ranking) -> list[Fitted]:
    """The smallest set of hypotheses that holds `probability_least` of all that is not "nothing"."""
    something = 1 - ranking.probabilities[NOTHING]
    members: list[Fitted] = []
    held = 0.0
    for f in ranking.ordered():
        if members and held >= case.settings.probability_least * something:
            break
        members.append(f)
        held += ranking.probabilities[f.hypothesis.label]
    return members


def _candidates(
    case: Case,
    ranking: Ranking,
    members: Sequence[Fitted],
    climbed: _Climb,
    ladder: Ladder,
    stick: Yardstick,
    thresholds: Mapping[str, float] | None,
) -> tuple[Candidate, ...]:
    added = climbed.models[-1].hypothesis.labels
    listed = ranking.ordered()
    shown = listed[: case.settings.candidates]
    shown += [f for f in listed if f not in shown and f.hypothesis.label in added]
    # What was added on a higher rung may be listed far down on the first.
    before = stick.error(ranking.base)
    result = []
    for f in shown:
        label = f.hypothesis.label
        title, signs = describe(f.hypothesis, case.library)
        heldout = float("nan")
        if f in members or label in added:
            heldout = stick.heldout_error(f, held_out(case, f, stick.fit, case.settings.folds))
        sizes = _sizes(case, f)
        needed = threshold(f.hypothesis.family, case.settings.gain_least, thresholds)
        family, _, place = label.partition("@")
        result.append(
            Candidate(
                effect=family,
                at=place,
                title=title,
                probability=ranking.probabilities[label],
                parameters=sizes,
                error_before=before,
                error_after=stick.error(f),
                heldout_before=ladder.rungs[0].heldout_error,
                heldout_error_after=heldout,
                gain=ranking.gain(f),
                threshold=needed,
                log_evidence=ranking.log_evidence(f),
                claimed=label in added,
                why=why(ranking.base, f, case.measured, signs),
            )
        )
    return tuple(result)


def _sizes(case: Case, f: Fitted) -> dict[str, EffectSize]:
    """Sizes of what the hypothesis adds, by their own names."""
    units = {p.name: p.unit for p in case.problem(f.hypothesis, case.settings.fit).rig.parameters.values()}
    last = f.hypothesis.labels[-1]
    out = {}
    for e in extras(case.rig, Hypothesis((last,)), case.library):
        if e.name in f.values:
            out[e.name.removeprefix(f"{last}.")] = EffectSize(f.values[e.name], f.std[e.name], units[e.name])
    return out


def _verdict(
    case: Case,
    screening: Screening,
    climbed: _Climb,
    members: Sequence[Fitted],
    ladder: Ladder,
    stick: Yardstick,
) -> tuple[VerdictWord, str]:
    top = climbed.models[-1]
    error = ladder.rungs[-1].error
    wrong = _misfit(case, climbed, stick, error)
    added = top.hypothesis.labels
    if screening.too_few:
        return "not_enough_data", screening.too_few
    if wrong and not added and len(members) > 1:
        names = ", ".join(label_text(f.hypothesis.label) for f in members)
        return "ambiguous", f"The model fails ({wrong}); each of these would mend it: {names}."
    if wrong:
        best = f" {label_text(added[0])} helps most but does not mend it." if added else ""
        return "unknown_effect", f"The model fails ({wrong}) and nothing in the library mends it.{best}"
    if not added:
        seen = _visible_share(case, climbed.rankings[0])
        if seen < 0.25:
            return "not_enough_data", (
                f"These data would show only {100 * seen:.0f} % of the effects in the library at a size to expect."
            )
        p = climbed.rankings[0].probabilities[NOTHING]
        left = _solid_unexplained(case, top)
        odd = f" Not explained, perhaps not of the rig: {', '.join(left)}." if left else ""
        return "adequate", (
            f"The model explains the data (error {error:.2f}); nothing is missing ({100 * p:.0f} %).{odd}"
        )
    if len(members) > 1:
        names = ", ".join(label_text(f.hypothesis.label) for f in members)
        return "ambiguous", f"Something is missing, but these explain the data alike: {names}."
    texts = []
    for label, model in zip(added, climbed.models[1:], strict=True):
        texts.append(f"{label_text(label)} ({size_text(_sizes(case, model))})")
    first, last = ladder.rungs[0], ladder.rungs[-1]
    return "effect", (
        f"Missing: {' and '.join(texts)}. Error {first.error:.3g} before, {last.error:.3g} after; "
        f"on held-out data {first.heldout_error:.3g} and {last.heldout_error:.3g}."
    )


def _misfit(case: Case, climbed: _Climb, stick: Yardstick, error: float) -> str:
    """Why even the best model does not hold, in words; empty where it does."""
    settings = case.settings
    top = climbed.models[-1]
    if not error <= settings.error_limit:
        return f"error {error:.3g}, {settings.error_limit:g} is the limit"
    solid = _solid_unexplained(case, top)
    if len(solid) > _SPURIOUS or np.mean(~top.explained) > settings.unexplained_limit:
        return f"{int(np.sum(~top.explained))} measured modes have no counterpart in it"
    return ""


def _mends(case: Case, f: Fitted, stick: Yardstick) -> bool:
    """True where a hypothesis alone makes the model hold."""
    few = np.mean(~f.explained) <= case.settings.unexplained_limit
    return bool(
        few and len(_solid_unexplained(case, f)) <= _SPURIOUS and stick.error(f) <= case.settings.error_limit
    )


def _solid_unexplained(case: Case, model: Fitted) -> list[str]:
    """Measured modes with well-determined shapes that a model does not explain."""
    found, start = [], 0
    for c, m in case.measured.items():
        left = ~model.explained[start : start + len(m)]
        start += len(m)
        for r in np.flatnonzero(left):
            if m.shapes is None or m.shape_std is None:
                found.append(f"{m.frequency_hz[r]:.1f} Hz ({c})")
                continue
            largest = float(np.nanmax(np.abs(m.shapes[r])))
            if np.nanmedian(m.shape_std[r]) < 0.03 * largest:
                found.append(f"{m.frequency_hz[r]:.1f} Hz ({c})")
    return found


def _unexplained_notes(case: Case, climbed: _Climb, stick: Yardstick) -> tuple[str, ...]:
    top, notes, start = climbed.models[-1], [], 0
    for c, m in case.measured.items():
        left = ~top.explained[start : start + len(m)]
        start += len(m)
        if np.any(left):
            which = ", ".join(f"{f:.1f}" for f in m.frequency_hz[left])
            notes.append(f"{c}: not explained by the best model: {which} Hz")
    if top.missed:
        notes.append(f"{top.missed} modes that the best model has in the band were not measured")
    return tuple(notes)


def _visible_share(case: Case, ranking: Ranking) -> float:
    """Share of the effects whose size the data would determine to less than half of what is to be expected."""
    seen, total = 0, 0
    for f in ranking.fitted:
        for e in extras(case.rig, f.hypothesis, case.library):
            if e.scale > 0 and e.name in f.std:
                total += 1
                seen += f.std[e.name] < 0.5 * e.scale
    return seen / total if total else 1.0


def _next(
    case: Case, verdict: VerdictWord, ranking: Ranking, members: Sequence[Fitted], stick: Yardstick
) -> str:
    if verdict == "ambiguous":
        option = best_measurement(case, members[0], members[1], stick.fit)
        pair = " from ".join(label_text(f.hypothesis.label) for f in members[:2])
        if option is None or option.separation < 1:
            return f"No single further measurement that was tried would tell {pair}."
        return f"{_capital(option.text)} would tell {pair}: expected difference {option.separation:.1f} σ."
    if verdict == "unknown_effect":
        return (
            "Hit at three force levels: if a natural frequency moves, the missing effect depends on amplitude; "
            "if not, put further sensors around the place named."
        )
    if verdict == "not_enough_data":
        return "Measure mode shapes at every body, in every configuration of the rig."
    if verdict == "adequate":
        ordered = ranking.ordered()
        doubtful = ranking.probabilities[NOTHING] < case.settings.probability_least
        if doubtful and ordered:
            option = best_measurement(case, ordered[0], ranking.base, stick.fit)
            if option is not None and option.separation > 2:
                name = label_text(ordered[0].hypothesis.label)
                return (
                    f"{_capital(option.text)} would show whether {name} is there: {option.separation:.1f} σ."
                )
    return ""


def _where(localised: Sequence[Localisation]) -> str:
    if not localised:
        return ""
    first = localised[0]
    return f" The misfit sits at {first.place} and acts like {first.acts_like}."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _part(tell: Progress, low: float, high: float) -> Progress:
    """Progress of a part of the work within the whole."""
    return lambda share, text: tell(low + (high - low) * share, text)
