"""The verdict: does a model hold, and what do the data say of what may be missing?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ema_pipeline.diagnose.climbing import Climb, at_bound
from ema_pipeline.diagnose.explain import label_text, size_text
from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.diagnose.hypotheses import NOTHING, Hypothesis, extras
from ema_pipeline.diagnose.ladder import Yardstick
from ema_pipeline.diagnose.ranking import Ranking, slight
from ema_pipeline.diagnose.screening import Screening
from ema_pipeline.diagnose.stray import solid_unexplained, strong_unexplained
from ema_pipeline.diagnose.thresholds import threshold
from ema_pipeline.diagnose.types import OUT_OF_TOLERANCE, EffectSize, Ladder, VerdictWord

_SPURIOUS = 2
"""Well-determined modes without counterpart that may still be of the foundation, or spurious."""
_ALIKE = 0.05
_VISIBLE_SHARE = 0.25
_STRAINED = 2.5


def judge_data(
    case: Case,
    screening: Screening,
    climbed: Climb,
    rung: int,
    members: Sequence[Fitted],
    ladder: Ladder,
) -> tuple[VerdictWord, str]:
    """The verdict and its sentence.

    Parameters
    ----------
    case : Case
    screening : Screening
    climbed : Climb
    rung : int
        From 0, the rung on which `members` are rivals.
    members : sequence of Fitted
        What explains the data alike, the most probable first.
    ladder : Ladder
    """
    top = climbed.top
    first = climbed.rankings[0]
    wrong = misfit(case, top, ladder.rungs[-1].error)
    added = top.hypothesis.labels
    if screening.too_few:
        return "not_enough_data", screening.too_few
    names = ", ".join(label_text(f.hypothesis.labels[-1]) for f in members)
    if wrong and not added and len(members) > 1:
        return (
            "ambiguous",
            f"The model fails ({wrong}); each of these would mend it: {names}.{_chance(first)}",
        )
    if wrong and not added and members:
        return "ambiguous", f"The model fails ({wrong}); {names} would mend it.{_chance(first)}"
    if wrong:
        best = f" {label_text(added[0])} helps most but does not mend it." if added else ""
        return "unknown_effect", f"The model fails ({wrong}) and nothing in the library mends it.{best}"
    if not added:
        seen = visible_share(case, first)
        if seen < _VISIBLE_SHARE:
            return "not_enough_data", (
                f"The model explains the data (error {ladder.rungs[-1].error:.2f}), but they would show only "
                f"{100 * seen:.0f} % of the effects in the library at a size to expect."
            )
        p = first.probabilities[NOTHING]
        left = solid_unexplained(case, top)
        odd = f" Not explained, perhaps not of the rig: {', '.join(left)}." if left else ""
        return "adequate", (
            f"The model explains the data (error {ladder.rungs[-1].error:.2f}); "
            f"nothing is missing ({100 * p:.0f} %).{odd}{_slight_text(case, first)}"
        )
    texts = [f"{label_text(label)} ({size_text(sizes(case, top, label))})" for label in added]
    if len(members) > 1:
        sure = f"Missing: {' and '.join(texts[:rung])}. " if rung else ""
        return (
            "ambiguous",
            f"{sure}Something {'else ' * (rung > 0)}is missing, but these explain the data alike: {names}.",
        )
    base, last = ladder.rungs[0], ladder.rungs[-1]
    return "effect", (
        f"Missing: {' and '.join(texts)}. Error {base.error:.3g} before, {last.error:.3g} after; "
        f"on held-out data {base.heldout_error:.3g} and {last.heldout_error:.3g}."
    )


def _slight_text(case: Case, ranking: Ranking) -> str:
    """The best explanation that is too small to count, where the data show it; empty where there is none."""
    shown = [
        f
        for f in ranking.fitted
        if slight(case, f)
        and ranking.gain(f) > threshold(f.hypothesis.family, case.settings.gain_least)
        and any(abs(s.value) > 2 * s.std for s in sizes(case, f).values())
    ]
    if not shown:
        return ""
    best = min(shown, key=lambda f: f.evidence)
    return (
        f" It would fit still better with {label_text(best.hypothesis.label)} "
        f"({size_text(sizes(case, best))}): as small as parts made to one drawing differ."
    )


def _chance(ranking: Ranking) -> str:
    """How probable it is that nothing is missing and stray modes fool us; empty where it is not."""
    p = ranking.probabilities[NOTHING]
    return f" Or else a measured mode is not of the rig ({100 * p:.0f} %)." if p > _ALIKE else ""


def sizes(case: Case, f: Fitted, label: str | None = None) -> dict[str, EffectSize]:
    """Sizes of one of the hypothesis' effects, the last where none is named, by their own names."""
    rig = case.rig_of(f.hypothesis)
    units = {p.name: p.unit for p in rig.parameters.values()}
    last = label or f.hypothesis.labels[-1]
    return {
        e.name.removeprefix(f"{last}."): EffectSize(f.values[e.name], f.std[e.name], units[e.name])
        for e in extras(case.rig, Hypothesis((last,)), case.library)
        if e.name in f.values
    }


def misfit(case: Case, model: Fitted, error: float) -> str:
    """Why a model does not hold, in words; empty where it does."""
    settings = case.settings
    if not error <= settings.error_limit:
        return f"error {error:.3g}, {settings.error_limit:g} is the limit"
    strong = strong_unexplained(case, model)
    if strong:
        at = ", ".join(f"{m.frequency_hz:.1f} Hz ({m.configuration})" for m in strong)
        modes = "modes measured at {} have" if len(strong) > 1 else "mode measured at {} has"
        return f"the {modes.format(at)} no counterpart in it"
    solid = solid_unexplained(case, model)
    if len(solid) > _SPURIOUS or np.mean(~model.explained) > settings.unexplained_limit:
        return f"{int(np.sum(~model.explained))} measured modes have no counterpart in it"
    return ""


def mending(case: Case, ranking: Ranking, stick: Yardstick) -> list[Fitted]:
    """Hypotheses that alone make the model hold, at a size that can be, not far less probable than the best of them."""
    found = [f for f in ranking.ordered() if not misfit(case, f, stick.error(f)) and not at_bound(case, f)]
    if not found:
        return []
    least = _ALIKE * ranking.probabilities[found[0].hypothesis.label]
    return [f for f in found if ranking.probabilities[f.hypothesis.label] >= least]


def unexplained_notes(case: Case, top: Fitted) -> tuple[str, ...]:
    """Measured modes that the best model does not have, and model modes that were not measured."""
    notes, start = [], 0
    for c, m in case.measured.items():
        left = ~top.explained[start : start + len(m)]
        start += len(m)
        if np.any(left):
            which = ", ".join(f"{f:.1f}" for f in m.frequency_hz[left])
            notes.append(f"{c}: not explained by the best model: {which} Hz")
    if top.missed:
        plural = "s" if top.missed > 1 else ""
        notes.append(f"{top.missed} mode{plural} that the best model has in the band not measured")
    return (*notes, *strained(case, top))


def strained(case: Case, model: Fitted) -> list[str]:
    """Parameters that a model's fit pushes far from their nominal values."""
    rig = case.problem(model.hypothesis, case.settings.fit).rig
    found = []
    for name, value in model.values.items():
        p = rig.parameters[name]
        if p.free or p.tolerance <= 0 or p.value == 0:
            continue
        shift = (value - p.value) / abs(p.tolerance * p.value)
        if abs(shift) > _STRAINED:
            found.append(f"{name} is fitted {shift:+.1f} tolerances from its nominal value")
    return found


def visible_share(case: Case, ranking: Ranking) -> float:
    """Share of the effects whose size the data would determine to less than half of what is to be expected."""
    seen, total = 0, 0
    for f in ranking.fitted:
        if f.hypothesis.family == OUT_OF_TOLERANCE:
            continue
        for e in extras(case.rig, f.hypothesis, case.library):
            if e.scale > 0 and e.name in f.std:
                total += 1
                seen += f.std[e.name] < 0.5 * e.scale
    return seen / total if total else 1.0
