"""The diagnosis in plain sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ema_pipeline.diagnose.explained import Explanation, OutlyingPart
from ema_pipeline.diagnose.types import NOT_DETERMINED, EffectSize, VerdictWord
from ema_pipeline.effects.out_of_tolerance import ID as OUT_OF_TOLERANCE
from ema_pipeline.inference import LEAST_LIMIT
from ema_pipeline.number_text import format_value
from ema_pipeline.plain_text import part_words

_SHOWN = 3
"""Parts that a sentence names."""


def label_text(label: str) -> str:
    """A label as a phrase."""
    effect, _, place = label.partition("@")
    if effect == OUT_OF_TOLERANCE:
        return f"parameter {place} out of tolerance"
    return f"{effect.replace('_', ' ')} at {place}"


def probability_text(p: float) -> str:
    """A probability in per cent that is never rounded to certainty.

    >>> probability_text(0.97), probability_text(0.99996), probability_text(1e-7)
    ('97 %', '>99.9 %', '<0.1 %')
    """
    if not math.isfinite(p):
        return "–"
    if p > 0.999:
        return ">99.9 %"
    if p < 0.001:
        return "<0.1 %"
    return f"{100 * p:.1f} %" if p < 0.0995 or p > 0.9895 else f"{100 * p:.0f} %"


def size_text(sizes: Mapping[str, EffectSize]) -> str:
    """``fraction 0.3500 ± 0.0020, …``."""
    own = {n: part_words(n.rpartition(".")[2]).replace("_", " ") for n in sizes}
    return ", ".join(f"{own[n]} {value_text(s)}" for n, s in sizes.items())


def value_text(s: EffectSize) -> str:
    """A size with its uncertainty and unit, or that the data do not determine it."""
    return format_value(s.value, s.std, s.unit) if s.determined else NOT_DETERMINED


def summary(
    verdict: VerdictWord,
    claimed: Sequence[tuple[str, str]],
    error: tuple[float, float],
    nothing: float,
    best: tuple[str, str] = ("", ""),
    reasons: str = "",
    beside: Sequence[tuple[str, str]] = (),
) -> str:
    """One to three sentences.

    Parameters
    ----------
    verdict : str
    claimed : sequence of (label, size)
        What is claimed, or explains the data equally well.
    error : (float, float)
        Before and after.
    nothing : float
        Probability that nothing is missing that these data would show.
    best : (label, why), optional
        The best candidate where none is claimed and one is worth a word, and why it is not; of a model that does not
        explain the data, one that would.
    reasons : str, optional
        Why the model does not explain the data, beside its error.
    beside : sequence of (label, size), optional
        What is claimed beside effects that explain the data equally well.
    """
    before, after = error
    named, sure = ("; ".join(f"{label_text(label)}, {size}" for label, size in x) for x in (claimed, beside))
    if verdict == "effect":
        added = "these" if len(claimed) > 1 else "this"
        return f"Missing from the model: {named}. Adding {added} reduces the error from {before:.2f} to {after:.2f}."
    if verdict == "ambiguous":
        first, added = (
            (f"Missing from the model: {sure}. Beside it, several", "it and one")
            if sure
            else ("Several", "one")
        )
        return (
            f"{first} effects explain the data equally well: {named}. Adding {added} of them reduces the error from "
            f"{before:.2f} to {after:.2f}."
        )
    if verdict == "adequate":
        odds = f"Probability that nothing is missing that these data would show: {probability_text(nothing)}."
        return " ".join(
            filter(None, (f"The model explains the data: error {before:.2f}. {odds}", _candidate(best)))
        )
    if verdict == "unknown_effect":
        closest = f" The closest {'are' if len(claimed) > 1 else 'is'} {named}." if named else ""
        how = "is supported enough to be claimed" if best[0] else "corrects this"
        told = f"{not_explained(f'{after:.2f}', after)}, and no effect in the library {how}.{closest}"
        return " ".join(filter(None, (told, _candidate(best), reasons)))
    return "These data are not sufficient to show what is missing."


def not_explained(told: str, error: float) -> str:
    """That a model fails, with its error as it is `told`, which alone does not always show that."""
    return f"The model does not explain the data ({'though its error is' if error <= LEAST_LIMIT else 'error'} {told})"


def _candidate(best: tuple[str, str]) -> str:
    return f"The best candidate is {label_text(best[0])}. {best[1]}" if best[0] else ""


STANDING_STILL = (
    "Modes move with the force of the hits, and no effect that moves them is supported by these data."
)


def reasons(found: Explanation, error: float) -> str:
    """Why a model does not explain the data, beside its `error`; empty where there is nothing to add."""
    alone = (
        f"The error of the modes alone is {found.by_modes:.2f}: many data of single hits, which fit, hide it."
    )
    of_scatters = (
        "Only a scatter that is larger than usual explains the data: with the usual one the error is "
        f"{found.by_scatter:.2f}."
    )
    of_damping = found.damping and (
        f"The damping ratios scatter by {100 * found.damping.scatter:.0f} % about the model's (1 σ of ln ζ), more "
        f"than the {100 * found.damping.usual:.0f} % of structures that lack no damper."
    )
    told = (
        STANDING_STILL if found.stands_still else "",
        alone if found.by_modes > error else "",
        of_scatters if found.by_scatter else "",
        of_damping or "",
        standing_out(found.parts),
    )
    return " ".join(filter(None, told))


def standing_out(parts: Sequence[OutlyingPart]) -> str:
    """Parts that deviate more than similar ones scatter; empty without any."""
    if not parts:
        return ""
    named = ", ".join(f"{part_words(p.name)} {100 * p.deviation:+.0f} %" for p in parts[:_SHOWN])
    scatter = 100 * max(p.others for p in parts[:_SHOWN])
    return (
        f"To follow the data the model must let parts deviate further than similar ones do: {named}. The others alone "
        f"scatter by {scatter:.1f} % (1 σ); the learned scatter includes these parts."
    )
