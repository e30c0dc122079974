"""Sentences on the diagnosis and the ladder, for the report and for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ema_pipeline.diagnose.sentences import label_text, probability_text, value_text
from ema_pipeline.diagnose.types import (
    OUT_OF_TOLERANCE,
    Candidate,
    DetectionLimit,
    Diagnosis,
    EffectSize,
    Ladder,
)
from ema_pipeline.number_text import plain, prefixed
from ema_pipeline.report.commands import command
from ema_pipeline.report.name_text import words

NOTHING = "nothing"
_COUNTS = {2: "Two", 3: "Three", 4: "Four", 5: "Five", 6: "Six"}


def heading(found: Diagnosis) -> str:
    """The verdict as a heading."""
    if found.verdict == "effect":
        return (
            f"Missing: {' and '.join(label_words(c.label) for c in claimed(found)) or 'see the candidates'}"
        )
    if found.verdict == "ambiguous":
        told, sure = heading_of_alike(found), " and ".join(label_words(c.label) for c in undisputed(found))
        return f"Missing: {sure}; beside it, {_lower(told)}" if sure else told
    closest = " and ".join(label_words(c.label) for c in claimed(found))
    if found.verdict == "unknown_effect" and closest:
        return f"Something is missing that the library does not explain; closest to it: {closest}"
    near = any(c.would_explain(found.error_limit) for c in found.candidates[:1])
    if found.verdict == "unknown_effect" and near:
        return "Something is missing, and no effect is supported enough to be named"
    known = " and ".join(map(label_words, found.ladder.rungs[0].effects)) if found.ladder.rungs else ""
    return {
        "adequate": f"{f'With {known} nothing' if known else 'Nothing'} is missing as far as these data can tell",
        "unknown_effect": "Something is missing that is not in the library",
        "not_enough_data": "Not enough data to show what is missing",
    }[found.verdict]


def heading_of_alike(found: Diagnosis) -> str:
    """How many effects the data do not tell apart."""
    count = len(found.indistinguishable[0]) if found.indistinguishable else 2
    return f"{_COUNTS.get(count, str(count))} effects explain the data equally well"


def label_words(label: str) -> str:
    """A label as a phrase, e.g. ``mesh stiffness loss at sun-planet1``."""
    return words(label_text(label))


def claimed(found: Diagnosis) -> tuple[Candidate, ...]:
    """Candidates that the data support, in the order of the ladder."""
    order = {label: k for k, label in enumerate(found.ladder.rungs[-1].effects)} if found.ladder.rungs else {}
    mine = [c for c in found.candidates if c.claimed]
    return tuple(sorted(mine, key=lambda c: order.get(c.label, len(order))))


def alike(found: Diagnosis) -> tuple[Candidate, ...]:
    """Candidates of which the data do not tell which one it is; none where there is no doubt."""
    group = found.indistinguishable[:1] if found.verdict == "ambiguous" else ()
    return tuple(c for c in found.candidates if any(c.label in labels for labels in group))


def undisputed(found: Diagnosis) -> tuple[Candidate, ...]:
    """Claimed candidates beside those of which the data do not tell which one it is."""
    return tuple(c for c in claimed(found) if c not in alike(found))


def leading(found: Diagnosis) -> tuple[Candidate, ...]:
    """What a reader should know of: the claimed candidates, the group that fits equally well, or the best one."""
    return (*undisputed(found), *alike(found)) or found.candidates[:1]


def size_words(parameters: Mapping[str, EffectSize], between: str = "; ") -> str:
    """Sizes with their uncertainty, e.g. ``fraction 0.3500 ± 0.0020``."""
    return between.join(f"{words(n)} {value_text(s)}" for n, s in parameters.items())


def standing(found: Diagnosis, candidate: Candidate) -> str:
    """What the data say of a candidate, in a word or two."""
    if candidate in alike(found):
        return "fits equally well"
    if candidate.claimed and found.verdict == "unknown_effect":
        return "best, not enough"
    if candidate.claimed:
        return "supported, not alone" if _not_alone(candidate) else "supported"
    if candidate.log_evidence < candidate.threshold:
        return "not enough evidence"
    return "less likely"


def parameter_words(name: str) -> str:
    """A parameter in words, e.g. ``spring at sun, stiffness`` for ``spring@sun.stiffness``."""
    label, dot, size = name.rpartition(".")
    return f"{label_words(label)}, {words(size)}" if dot and "@" in label else words(name)


def effects_words(labels: Sequence[str]) -> str:
    """Effects of a model in a row, e.g. ``spring at sun + cubic spring at ring.x``."""
    return " + ".join(map(label_words, labels))


def model_words(labels: Sequence[str]) -> str:
    """A model by its effects, in a sentence."""
    return f"the model with {effects_words(labels)}" if labels else "the base model"


def rung_words(before: Sequence[str], effects: Sequence[str]) -> str:
    """What a rung adds, e.g. ``+ mesh stiffness loss at sun-planet1``."""
    if not effects:
        return "base model"
    added = [label_words(e) for e in effects if e not in before]
    dropped = [label_words(e) for e in before if e not in effects]
    return " ".join([*(f"+ {t}" for t in added), *(f"− {t}" for t in dropped)]) or "the same"


def unexplained_words(ladder: Ladder) -> str:
    """Measured modes without a counterpart that are no doubles, before and after; empty where there are none."""
    if not ladder.rungs or not any(r.unexplained for r in ladder.rungs):
        return ""
    first, last = ladder.rungs[0].unexplained, ladder.rungs[-1].unexplained
    if len(ladder.rungs) == 1:
        return f"Measured modes that the model does not explain: {first}."
    return f"Measured modes that the model does not explain: {first} before, {last} after."


def reasons(found: Diagnosis) -> tuple[str, ...]:
    """What was suspected and why, one text per candidate that matters."""
    if found.verdict in ("adequate", "not_enough_data"):
        return ()
    return tuple(
        f"{_capital(label_words(c.label))}: {c.title}. {c.why}{_also_called(c)}" for c in leading(found)
    )


def _also_called(c: Candidate) -> str:
    """Other names of the same change of the model; empty where there are none."""
    return f" Also called: {', '.join(label_words(x) for x in c.equivalents)}." if c.equivalents else ""


def perhaps_words(found: Diagnosis) -> str:
    """The candidate that an adequate model may miss; empty without one."""
    c = found.suspected
    if c is None:
        return ""
    probable = f"{probability_text(c.probability)}, sizes that would not show included"
    return f"Perhaps {label_words(c.label)} ({probable}), not supported enough to be claimed."


def or_words(c: Candidate) -> str:
    """The parameter whose change is the same, e.g. ``or parameter k8 out of tolerance``; empty without one."""
    others = [label for label in c.equivalents if label.partition("@")[0] == OUT_OF_TOLERANCE]
    return f"or {label_words(others[0])}" if others else ""


def detection_words(found: Diagnosis) -> str:
    """What these data would show, in one sentence; empty where that is not known."""
    shown = [
        f"{words(effect)} {'≤' if sizes[0].largest else '≥'} {limit_words(sizes[0])}"
        for effect, sizes in limits_by_effect(found).items()
        if effect != OUT_OF_TOLERANCE and sizes[0].seen
    ]
    if not shown:
        return ""
    return f"These data would show, nine times in ten and at the best place: {', '.join(shown)}."


def limits_by_effect(found: Diagnosis) -> dict[str, list[DetectionLimit]]:
    """Limits of each effect, that of the best place first: the smallest, or the largest of what shows the less."""
    grouped: dict[str, list[DetectionLimit]] = {}
    for limit in found.detection_limits:
        effect = limit.label.rpartition(" + ")[2].partition("@")[0]
        grouped.setdefault(effect, []).append(limit)
    return {
        effect: sorted(limits, key=lambda x: -x.size if x.largest else x.size)
        for effect, limits in grouped.items()
    }


def limit_words(limit: DetectionLimit) -> str:
    """The size of a detection limit: in percent, or with its unit."""
    if not limit.seen:
        return "no size"
    if limit.unit in ("", "1"):
        return f"{plain(100 * limit.size, 2)} %"
    scale, unit = prefixed(limit.size, limit.unit)
    return f"{plain(scale * limit.size, 2)} {unit}"


def of_modes(ladder: Ladder) -> bool:
    """True where the ladder is measured by modes, not by time histories or force loops."""
    return ladder.frequency_noise > 0


def noise_words(ladder: Ladder) -> str:
    """What σ includes in addition to the test's own scatter."""
    if not of_modes(ladder):
        return "σ: the scatter of the measured signals."
    return (
        f"σ: the test's own scatter plus {plain(100 * ladder.frequency_noise, 2)} % of frequency, "
        f"{plain(100 * ladder.damping_noise, 2)} % of damping, "
        f"{plain(100 * ladder.shape_noise, 2)} % of a shape's largest entry."
    )


def sigma_words(found: Diagnosis) -> str:
    """Why the error without an effect differs from candidate to candidate; empty where it does not."""
    if len({plain(c.error_before, 3) for c in found.candidates} | {plain(found.error, 3)}) < 2:
        return ""
    return (
        "σ includes the scatter of parts and sensors that is learned with each effect, and differs from row to row: "
        "compare rows by their probability, not by their error."
    )


def group_words(found: Diagnosis) -> tuple[str, ...]:
    """One sentence per group that the data cannot tell apart."""
    said = (
        "The same change of the model under several names"
        if found.verdict == "effect"
        else "These data cannot tell apart"
    )
    return tuple(
        f"{said}: {'; '.join(label_words(label) for label in group)}." for group in found.indistinguishable
    )


def compact(found: Diagnosis) -> str:
    """Verdict, best candidates with probability and size, error before and after, in a sentence or two."""
    if found.verdict == "adequate":
        odds = probability_text(found.adequate_probability)
        return (
            f"Diagnosis: {_lower(heading(found))} (probability {odds}); error {plain(found.error, 3)}, "
            f"{plain(found.heldout_error, 3)} on held-out data. {perhaps_words(found)}"
        ).rstrip()
    if found.verdict == "not_enough_data":
        return f"Diagnosis: {_lower(heading(found))}. {found.summary}"
    if found.verdict == "effect":
        return f"Diagnosis: {_named(found)}. {unexplained_words(found.ladder)}".rstrip()
    return f"Diagnosis: {_lower(heading(found))}. Best in the library: {_named(found)}."


def _named(found: Diagnosis) -> str:
    missing = "missing: " if found.verdict == "effect" else ""
    named = "; ".join(
        f"{missing}{label_words(c.label)}"
        + (f", {size_words(c.parameters, ', ')}" if c.parameters else "")
        + f" (probability {probability_text(c.probability)}, {_fall(c)})"
        for c in leading(found)
    )
    return named or "nothing"


def _fall(c: Candidate) -> str:
    if c.claimed and _not_alone(c):
        return "beside the others"
    return f"error {plain(c.error_before, 3)} → {plain(c.error_after, 3)}"


def _not_alone(c: Candidate) -> bool:
    """True for the first of two that are missing beside which parts are still bent for the other one."""
    return c.error_after >= c.error_before


def next_commands(
    found: Diagnosis, out: str = "OUT", added: Sequence[str] = (), effect_files: Sequence[str] = ()
) -> tuple[str, ...]:
    """What a user would type next.

    Parameters
    ----------
    found : Diagnosis
    out : str
        Results folder as the user would type it.
    added : sequence of str
        Labels that are in the model already.
    effect_files : sequence of str
        Files with the user's own effects.
    """

    def on_folder(verb: str, *words: str, files: Sequence[str] = effect_files) -> str:
        return command(verb, out, *words, effect_files=files)

    if found.verdict == "effect":
        new = [c.label for c in claimed(found) if c.label not in added]
        return (on_folder("add", *new), on_folder("ladder")) if new else ()
    if found.verdict == "ambiguous":
        # one of them, the user's choice: each line stands for itself
        sure = [c.label for c in undisputed(found) if c.label not in added]
        return tuple(on_folder("add", *sure, c.label) for c in alike(found) if c.label not in added)
    if found.verdict == "unknown_effect":
        return on_folder("compare"), on_folder("diagnose", files=(*effect_files, "my_effect.py"))
    return ()


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
