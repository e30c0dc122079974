"""Which effect makes a structure answer otherwise to hard hits than to soft ones? From hits to a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.diagnose.explain import compared_text, label_text, size_text
from ema_pipeline.diagnose.hypotheses import NOTHING, describe
from ema_pipeline.diagnose.levels import words
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, error_of
from ema_pipeline.diagnose.levels.climbing import Climbed, climbed_views, started
from ema_pipeline.diagnose.levels.detection import detection_limits
from ema_pipeline.diagnose.levels.ladder import LevelErrors, assemble, level_errors, sizes_of
from ema_pipeline.diagnose.levels.linear_claims import replaced, withdrawn, without
from ema_pipeline.diagnose.levels.problem import NoiseFloor
from ema_pipeline.diagnose.levels.search import LevelRanking
from ema_pipeline.diagnose.progress import Progress, part
from ema_pipeline.diagnose.types import Candidate, DetectionLimit, Diagnosis, EffectSize, Ladder, VerdictWord
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.threads import single_blas_thread

_HARDER = 2.0
"""A next test is thought of with blows this much harder than the hardest."""


def diagnose_levels(
    case: LevelCase,
    effects: Sequence[str],
    linear: Diagnosis | None,
    summary: str,
    notes: Sequence[str],
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the effects that depend on the force level.

    Parameters
    ----------
    case : LevelCase
    effects : sequence of str
        Effects of the model already, and those that the modes of one level show to be missing besides.
    linear : Diagnosis, optional
        What the modes of a single level say.
    summary : str
        What the study of the levels found.
    notes : sequence of str
        Remarks of earlier stages.
    progress : callable, optional

    Returns
    -------
    Diagnosis
    """
    tell = progress or (lambda share, text: None)
    with single_blas_thread():
        return _diagnose(case, tuple(effects), linear, summary, tuple(notes), tell)


def _diagnose(
    case: LevelCase,
    effects: tuple[str, ...],
    linear: Diagnosis | None,
    summary: str,
    notes: tuple[str, ...],
    tell: Progress,
) -> Diagnosis:
    start = started(case, effects, tell)
    if linear is not None and (idle := replaced(case, start[-1], _claims(linear))):
        effects, linear = tuple(x for x in effects if x not in idle), without(linear, idle)
        start = started(case, effects, tell)
    climbed = climbed_views(case, effects, start, tell)
    if linear is not None and (idle := withdrawn(case, climbed.models[-1], _claims(linear))):
        effects, linear = tuple(x for x in effects if x not in idle), without(linear, idle)
        climbed = climbed_views(case, effects, started(case, effects, tell), tell)
    followed = climbed.holds(case)
    case = climbed.case
    first, base = climbed.rankings[0], climbed.rankings[0].base
    forces = [float(f) for f in case.windows[0].force_n]
    tell(0.8, "predicting held-out levels")
    before = level_errors(case, base, climbed.floor)
    members = _group(case, first)
    ladder = assemble(case, climbed.models, climbed.floor, climbed.note, part(tell, 0.82, 0.95))
    candidates = _candidates(case, climbed, members, before, forces)
    verdict, text = _verdict(case, climbed, members, ladder, summary)
    claimed = _claims(linear)
    if claimed and verdict in ("adequate", "effect"):
        verdict = "effect"
        text = f"{_claim_text(claimed)} {text}" if text else _claim_text(claimed)
    group = verdict == "ambiguous"
    return Diagnosis(
        verdict=verdict,
        summary=text,
        null_probability=first.probabilities[NOTHING],
        candidates=(*candidates, *claimed),
        indistinguishable=(tuple(m.hypothesis.labels[-1] for m in members),) if group else (),
        next_measurement=_next(case, members, climbed.floor) if group else _otherwise(verdict),
        localisation=(),
        probabilities=_by_last(first),
        error=before.error,
        heldout_error=before.heldout_error,
        ladder=ladder,
        detection_limits=_limits(climbed) if followed else (),
        notes=(
            *((summary,) if summary else ()),
            *(linear.notes if linear is not None else ()),
            *filter(None, (compared_text(ladder),)),
            *notes,
        ),
    )


def _group(case: LevelCase, ranking: LevelRanking) -> list[Simulated]:
    """The smallest set of hypotheses that holds `probability_least` of all that is not "nothing"."""
    something = 1 - ranking.probabilities[NOTHING]
    members: list[Simulated] = []
    held = 0.0
    for m in ranking.ordered():
        if members and held >= case.settings.probability_least * something:
            break
        members.append(m)
        held += ranking.probabilities[m.hypothesis.label]
    return members


def _by_last(ranking: LevelRanking) -> dict[str, float]:
    """Probabilities by the label of the effect added last."""
    names = {m.hypothesis.label: m.hypothesis.labels[-1] for m in ranking.fitted}
    return {names.get(label, label): p for label, p in ranking.probabilities.items()}


def _candidates(
    case: LevelCase,
    climbed: Climbed,
    members: Sequence[Simulated],
    before: LevelErrors,
    forces: Sequence[float],
) -> tuple[Candidate, ...]:
    first, *later = climbed.rankings
    added = climbed.models[-1].hypothesis.labels
    listed = first.ordered()
    shown = listed[: case.settings.candidates]
    shown += [m for m in listed if m not in shown and m.hypothesis.labels[-1] in added]
    rows = [(first, m, before) for m in shown]
    # what was found only beside another effect is judged by what it adds to that
    told = {m.hypothesis.labels[-1] for m in shown}
    for ranking in later:
        new = [m for m in ranking.ordered() if m.hypothesis.labels[-1] in set(added) - told]
        errors = level_errors(case, ranking.base, climbed.floor) if new else before
        rows += [(ranking, m, errors) for m in new[:1]]
        told |= {m.hypothesis.labels[-1] for m in new[:1]}
    result = []
    for ranking, m, before in rows:
        label = m.hypothesis.labels[-1]
        title, signs = describe(m.hypothesis, case.library)
        full = any(m is x for x in members) or label in added
        after = level_errors(case, m, climbed.floor, hold_out=full)
        family, _, place = label.partition("@")
        result.append(
            Candidate(
                effect=family,
                at=place,
                title=title,
                probability=ranking.probabilities[m.hypothesis.label],
                parameters=_own_sizes(
                    case, climbed.models[-1] if label in added else m, climbed.floor, label
                ),
                error_before=before.error,
                error_after=after.error,
                heldout_before=before.heldout_error,
                heldout_error_after=after.heldout_error,
                gain=ranking.gain(m),
                threshold=case.settings.levels.gain_least,
                log_evidence=ranking.log_evidence(m),
                claimed=label in added,
                why=words.why(signs, forces, before, after),
            )
        )
    return tuple(result)


def _own_sizes(case: LevelCase, m: Simulated, floor: NoiseFloor, label: str) -> dict[str, EffectSize]:
    """Sizes of one effect of a model, by their own names."""
    own = [f"{label}.{p.name}" for p in case.parameters_of(label)]
    return {
        n.removeprefix(f"{label}."): v
        for n, v in sizes_of(case, m, floor, [n for n in own if n in m.values]).items()
    }


def _verdict(
    case: LevelCase, climbed: Climbed, members: Sequence[Simulated], ladder: Ladder, summary: str
) -> tuple[VerdictWord, str]:
    last = climbed.models[-1]
    error = error_of(case, last)
    known = climbed.rankings[0].base.hypothesis.labels
    added = [x for x in last.hypothesis.labels if x not in known]
    nonlinear = [x for x in last.hypothesis.labels if depends_on_level(x, case.library)]
    limit = case.settings.error_limit
    if not error <= limit:
        best = f" {label_text(added[0]).capitalize()} helps most but does not mend it." if added else ""
        return "unknown_effect", (
            f"The answer depends on the force level, and nothing in the library explains how (error {error:.3g}, "
            f"{limit:g} is the limit).{best}"
        )
    if not nonlinear and len(members) > 1 and _mending(case, climbed, members):
        return "ambiguous", (
            f"The answer depends on the force level, and these explain it alike: "
            f"{words.names([m.hypothesis.labels[-1] for m in members])}."
        )
    if not (nonlinear or added) and _mending(case, climbed, members):
        best = label_text(members[0].hypothesis.labels[-1]).capitalize()
        return "unknown_effect", (
            f"The answer depends on the force level. {best} fits best, but is not confirmed: its size may be nothing, "
            "or the levels left out of the fit are not predicted better with it."
        )
    if not nonlinear:
        return "unknown_effect", (
            "The answer depends on the force level, but no effect of the library explains how better than chance."
        )
    if added and len(members) > 1:
        return "ambiguous", (
            f"Something is missing that depends on the force level, but these explain the data alike: "
            f"{words.names([m.hypothesis.labels[-1] for m in members])}."
        )
    if not added:
        return (
            "adequate",
            f"The model explains the hits at all levels (error {error:.2f}); nothing is missing.",
        )
    texts = [
        f"{label_text(label)} ({size_text(_own_sizes(case, last, climbed.floor, label))})" for label in added
    ]
    rungs = ladder.rungs[-len(added) - 1], ladder.rungs[-1]
    known = np.all(np.isfinite([r.heldout_misfit for r in rungs]), axis=0)
    before, after = (np.where(known, r.heldout_misfit, r.misfit) for r in rungs)
    k = int(np.nanargmax(np.where(known | ~known.any(), before - after, np.nan)))
    left_out = ", that level being left out of the fit" if known[k] else ""
    return "effect", (
        f"Missing: {' and '.join(texts)}. Simulated hits miss {100 * before[k]:.2g} % of the signals at "
        f"{ladder.force_n[k]:.3g} N without it and {100 * after[k]:.2g} % with it{left_out}."
    )


def _mending(case: LevelCase, climbed: Climbed, members: Sequence[Simulated]) -> bool:
    """True where something of the library helps for sure, though it cannot be told what."""
    ranking, s = climbed.rankings[0], case.settings
    sure = 1 - ranking.probabilities[NOTHING] >= s.probability_least
    return sure and ranking.gain(members[0]) >= s.levels.gain_least


def _limits(climbed: Climbed) -> tuple[DetectionLimit, ...]:
    """What these hits would show of the effects that depend on the level."""
    case, first = climbed.case, climbed.rankings[0]
    nonlinear = [
        m.hypothesis for m in first.fitted if depends_on_level(m.hypothesis.labels[-1], case.library)
    ]
    return detection_limits(case, nonlinear, climbed.models[-1], climbed.floor)


def _claims(linear: Diagnosis | None) -> tuple[Candidate, ...]:
    """What the modes of one level show to be missing, whatever the level."""
    if linear is None or linear.verdict != "effect":
        return ()
    return tuple(c for c in linear.candidates if c.claimed)


def _claim_text(claimed: Sequence[Candidate]) -> str:
    texts = [f"{label_text(c.label)} ({size_text(c.parameters)})" for c in claimed]
    return f"Missing at every level: {' and '.join(texts)}."


def _otherwise(verdict: VerdictWord) -> str:
    if verdict == "unknown_effect":
        return (
            "Hit at more levels between the softest and the hardest, and next to each bearing and mesh: the place "
            "whose hits change most with the force is nearest to the effect."
        )
    return ""


def _next(case: LevelCase, members: Sequence[Simulated], floor: NoiseFloor) -> str:
    """The impact point at which blows of twice the force would tell the first two of a group apart."""
    one, two = members[:2]
    harder = replace(
        case,
        windows=tuple(
            replace(w.only(w.level == w.level.max()), force=_HARDER * w.only(w.level == w.level.max()).force)
            for w in case.windows
        ),
    )
    first, second = (
        p.lines(p.space.point(m.values)[None])
        for m in (one, two)
        for p in [harder.problem(m.hypothesis, m.sizes)]
    )
    best, where, force = 0.0, "", 0.0
    for w, a, b, weight in zip(harder.windows, first, second, harder.weights(floor), strict=True):
        r = replace(weight, measured=b[0]).applied(a)[0]
        z = np.sqrt(np.sum(np.abs(r) ** 2, axis=(1, 2))) / _HARDER
        if z.max() > best:
            best, where = float(z.max()), f"{w.impacts[int(np.argmax(z))]} ({w.configuration})"
            force = _HARDER * float(w.force_n[w.level.max()])
    pair = " from ".join(label_text(m.hypothesis.labels[-1]) for m in members[:2])
    if best < 1:
        return (
            f"Blows of {_HARDER:g} times the force would not tell {pair} either; put sensors on both places."
        )
    return f"Blows of {force:.0f} N on {where} would tell {pair}: expected difference {best:.1f} σ."
