"""The top of the page: the verdict in a sentence, what it rests on, three numbers before and after, what to type."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.types import UNKNOWN, Diagnosis, Rung
from ema_pipeline.number_text import plain
from ema_pipeline.report import diagnosis
from ema_pipeline.report.cautions import suspect, suspicions
from ema_pipeline.report.effect_places import EffectPlaces, effect_places
from ema_pipeline.report.results import RunResults
from ema_pipeline.report.shapes import drawing_for
from ema_pipeline.report.summary import commands_left

_WORTH_A_WORD = 0.01
"""Probability of an effect that is not in the library from which it is told."""
_OTHERS = 3
"""Less likely explanations that are named."""
_MOST_SUSPECTED = 3
"""Hits and sensors that are named; the cautions have them all."""


@dataclass(frozen=True)
class Tile:
    """A number of the base model and of the model with effects; `after` is empty where there is none."""

    name: str
    before: str
    after: str
    words: str


@dataclass(frozen=True)
class PageTop:
    """What a reader sees first.

    Attributes
    ----------
    heading, summary : str
        The verdict and one or two sentences on it; of the modes alone where there is no model.
    doubt : str
        That a hit or a sensor is suspected, with which all that follows stands or falls; empty where none is.
    suspected : tuple of str
        Which ones, and what to look up.
    tiles : tuple of Tile
    reasons : tuple of str
        Why the named effects are suspected.
    against : tuple of str
        What stands against the verdict, or limits it.
    next : str
        What to measure next; may be empty.
    commands : tuple of str
        What a user would type next.
    drawing : EffectPlaces or None
    """

    heading: str
    summary: str
    doubt: str = ""
    suspected: tuple[str, ...] = ()
    tiles: tuple[Tile, ...] = ()
    reasons: tuple[str, ...] = ()
    against: tuple[str, ...] = ()
    next: str = ""
    commands: tuple[str, ...] = ()
    drawing: EffectPlaces | None = None


def page_top(results: RunResults) -> PageTop:
    """The top of the page for these results."""
    found, doubted = results.diagnosis, suspect(results)
    plain_top = PageTop(
        _heading_without_diagnosis(results),
        "",
        f"{doubted} is suspected: what follows is valid only if it is right." if doubted else "",
        suspicions(results)[:_MOST_SUSPECTED],
        _tiles(results),
    )
    if found is None:
        return plain_top
    known = replace(plain_top, commands=commands_left(results, results.folder), drawing=_drawing(results))
    if results.diagnosis_is_old:
        told = "The diagnosis below is older than this change; repeat it to see what is still missing."
        return replace(known, heading=_changed(results), summary=told)
    return replace(
        known,
        heading=diagnosis.heading(found),
        summary=found.summary,
        reasons=diagnosis.reasons(found),
        against=_against(found),
        next=found.next_measurement,
    )


def _changed(results: RunResults) -> str:
    """What is different from what the diagnosis was made of."""
    names = " + ".join(map(diagnosis.label_words, results.added)) or "no effects"
    if results.added == results.diagnosed_on:
        return "Other hits or modes than in the diagnosis"
    return f"In the model: {names}"


def _heading_without_diagnosis(results: RunResults) -> str:
    count = sum(len(c.modal.modes) for c in results.configurations if c.modal)
    if results.loops is not None:
        return f"{len(results.loops.loops)} loops identified; not diagnosed yet"
    if not count:
        return "No modes have been identified yet"
    return f"{count} modes identified" + ("" if results.rig else "; there is no model to compare them with")


def _rungs(results: RunResults) -> tuple[Rung, Rung] | None:
    ladder = results.shown_ladder
    return None if ladder is None or not ladder.rungs else (ladder.rungs[0], ladder.rungs[-1])


def _tiles(results: RunResults) -> tuple[Tile, ...]:
    ends = _rungs(results)
    if ends is None:
        error = math.nan if results.comparison is None else results.comparison.error
        if not math.isfinite(error):
            return ()
        return (Tile("error", plain(error, 3), "", "about 1 where the model explains the data"),)
    first, last = ends
    changed = first is not last
    then = "; then with what is proposed" if changed and last.effects != results.added else ""
    tiles = [
        Tile(
            "error", plain(first.error, 3), plain(last.error, 3) if changed else "",
            f"root mean square of (measured − model)/σ: about 1 where the model explains the data{then}",
        ),
        Tile(
            "error held out", plain(first.heldout_error, 3), plain(last.heldout_error, 3) if changed else "",
            "the same on data that the fit has not seen",
        ),
    ]  # fmt: skip
    compared, ladder = results.comparison, results.shown_ladder
    total = 0 if compared is None else len(compared.modes) + len(compared.alone)
    if total and ladder is not None and diagnosis.of_modes(ladder):
        more = last.unexplained != first.unexplained
        tiles.append(
            Tile(
                "modes explained", f"{total - first.unexplained} of {total}",
                f"{total - last.unexplained} of {total}" if more else "",
                "measured modes that the diagnosis assigns to one of the model, however unlike; duplicates count, "
                "those above its highest do not",
            )
        )  # fmt: skip
    return tuple(tiles)


def _against(found: Diagnosis) -> tuple[str, ...]:
    """What a careful reader would hold against the verdict."""
    lines = list(diagnosis.group_words(found))
    named = {c.label for c in diagnosis.leading(found)}
    if found.verdict in ("effect", "ambiguous", "unknown_effect"):
        nothing = probability_text(found.null_probability)
        others = [
            f"{diagnosis.label_words(c.label)} ({probability_text(c.probability)})"
            for c in found.candidates
            if c.label not in named
        ][:_OTHERS]
        unknown = found.probabilities.get(UNKNOWN, 0.0)
        lines.append(
            f"Nothing missing at all has probability {nothing}"
            + (f", {UNKNOWN} {probability_text(unknown)}" if unknown > _WORTH_A_WORD else "")
            + (f"; less likely: {', '.join(others)}." if others else ".")
        )
    if found.verdict == "adequate":
        lines += [text for text in (diagnosis.detection_words(found),) if text]
    return (*lines, *found.notes)


def _drawing(results: RunResults) -> EffectPlaces | None:
    """The rig with the places of what is named or added; of the configuration with most bodies."""
    places = _places(results)
    drawings = [effect_places(drawing_for(c), places) for c in results.configurations]
    known = [d for d in drawings if d is not None]
    return max(known, key=lambda d: len(d.bodies), default=None)


def _places(results: RunResults) -> Sequence[str]:
    if results.added:
        return [label.partition("@")[2] for label in results.added]
    found = results.diagnosis
    if found is None or found.verdict not in ("effect", "ambiguous"):
        return []
    return [c.at for c in diagnosis.leading(found)]
