"""The diagnosis and the ladder in tables, for the report and for the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.types import (
    EXTRA_COORDINATE,
    NOT_DETERMINED,
    OUT_OF_TOLERANCE,
    Candidate,
    DetectionLimit,
    Diagnosis,
    EffectSize,
    Ladder,
    Rung,
)
from ema_pipeline.effects.base import effect_of
from ema_pipeline.number_text import format_value, plain
from ema_pipeline.report.diagnosis import (
    label_words,
    limit_words,
    limits_by_effect,
    of_modes,
    parameter_words,
    rung_words,
    size_words,
)
from ema_pipeline.report.name_text import words
from ema_pipeline.report.tables import Row, Table


def candidates_table(found: Diagnosis) -> Table:
    """The candidates as they fit 80 columns: errors after adding each; last those where nothing is missing.

    `diagnosis.sigma_words` says why errors of two rows are not comparable.
    """
    rows = [
        Row(
            (
                label_words(c.label),
                size_words(c.parameters, ";\n"),
                probability_text(c.probability),
                plain(c.error_after, 3),
                plain(c.heldout_error_after, 3),
            ),
            _stands_out(found, c),
        )
        for c in found.candidates
    ]
    rows.append(
        Row(
            (
                "nothing missing at all",
                "",
                probability_text(found.null_probability),
                plain(found.error, 3),
                plain(found.heldout_error, 3),
            ),
        )
    )
    return Table(
        ("if this is added", "size (±1σ)", "probable", "error", "held out"),
        tuple(rows),
        frozenset({2, 3, 4}),
    )


def ladder_table(ladder: Ladder) -> Table:
    """One row per model from the base model upwards, each with what it adds to the one before."""
    rows: list[Row] = []
    before: tuple[str, ...] = ()
    for rung in ladder.rungs:
        rows.append(
            Row(
                (
                    rung_words(before, rung.effects),
                    size_words(_own_sizes(before, rung.effects, rung.parameters), ";\n"),
                    plain(rung.error, 3),
                    plain(rung.heldout_error, 3),
                    str(rung.unexplained) if of_modes(ladder) else "",
                    plain(rung.log_evidence, 3),
                )
            )
        )
        before = rung.effects
    head = ("model", "size (±1σ)", "error, σ", "held out, σ", "modes left", "ln evidence")
    return Table(head, tuple(rows), frozenset({2, 3, 4, 5}))


def rung_table(rung: Rung) -> Table:
    """One row per fitted parameter of one model, those of effects last."""
    names = sorted(rung.parameters, key=lambda name: "@" in name)
    rows = []
    for name in names:
        size = rung.parameters[name]
        value = format_value(size.value, size.std, size.unit)
        rows.append(Row((parameter_words(name), value if size.determined else NOT_DETERMINED)))
    return Table(("parameter", "fitted (±1σ)"), tuple(rows), frozenset())


def detection_table(found: Diagnosis) -> Table:
    """Least size of every effect that these data would show, or the largest, at the best and at the worst place."""
    rows = []
    for effect, limits in limits_by_effect(found).items():
        best, worst = limits[0], limits[-1]
        rows.append(
            Row(
                (
                    words(effect),
                    words(best.parameter) if effect != OUT_OF_TOLERANCE else "deviation",
                    _seen(best),
                    _seen(worst) if len(limits) > 1 else "",
                )
            )
        )
    return Table(
        ("effect", "size", "seen from (best place)", "seen from (worst place)"), tuple(rows), frozenset()
    )


def _seen(limit: DetectionLimit) -> str:
    """Size and place; of what is seen up to a size it says so."""
    up_to = "up to " if limit.largest and limit.seen else ""
    return f"{up_to}{limit_words(limit)} ({_place(limit)})"


def _place(limit: DetectionLimit) -> str:
    return words(limit.label.rpartition("@")[2])


def scatter_table(ladder: Ladder) -> Table:
    """What was stated of everything that scatters, and what was learned from the data."""
    rows = tuple(
        Row((s.title, f"{plain(100 * s.stated, 2)} %", f"{plain(100 * s.learned, 2)} %"))
        for s in ladder.scatters
    )
    return Table(("of", "stated", "learned"), rows, frozenset({1, 2}))


def localisation_table(found: Diagnosis) -> Table:
    """Where the misfit sits and how it acts, best first."""
    units = {
        "stiffness": "N/m",
        "mass": "kg",
        "viscous damping": "N·s/m",
        "hysteretic damping": "N/m",
        EXTRA_COORDINATE: "Hz",
    }
    rows = tuple(
        Row(
            (
                place.place,
                place.acts_like,
                format_value(place.size, math.nan, units.get(place.acts_like, "")),
                plain(place.score, 3),
            )
        )
        for place in found.localisation
    )
    return Table(("where", "acts like", "size", "ln evidence it promises"), rows, frozenset({2, 3}))


def _stands_out(found: Diagnosis, c: Candidate) -> bool:
    return c.claimed or any(c.label in group for group in found.indistinguishable)


def _own_sizes(
    before: Sequence[str], effects: Sequence[str], parameters: Mapping[str, EffectSize]
) -> dict[str, EffectSize]:
    """Sizes of what this rung adds, by their own names."""
    own: dict[str, EffectSize] = {}
    for label in effects:
        if label in before:
            continue
        _, _, place = label.partition("@")
        for name, size in parameters.items():
            if effect_of(name) == label:
                own[name.removeprefix(f"{label}.")] = size
            elif label == f"out_of_tolerance@{name}":
                own[place] = size
    return own
