"""What the modes of one level show to be missing, held against the hits of all levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.diagnose.hypotheses import Hypothesis, extras, make_rig, starting_points
from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, level_hypotheses
from ema_pipeline.diagnose.levels.search import Growing, again, fit_effect, own_floor
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Candidate, Diagnosis
from ema_pipeline.effects.library import Library, depends_on_level
from ema_pipeline.rigs.types import Rig

_NOTHING_LEFT, _ELSEWHERE = 2.0, 3.0
"""Standard deviations: a size vanishes within the first of nothing, and beyond the second of what was claimed."""


def replaced(case: LevelCase, base: Simulated, claimed: Sequence[Candidate]) -> set[str]:
    """Effects claimed from the modes of one level that vanish beside one at the same place that the hits show.

    Seen at once, these need no ranking of everything else on top of them. `base` is the model with them all.
    """
    places = {c.at for c in claimed if c.label in base.hypothesis.labels}
    if not places:
        return set()
    windows = Growing(case, case.floor, base)
    for h in level_hypotheses(case, base.hypothesis):
        if h.labels[-1].partition("@")[2] not in places:
            continue
        found = fit_effect(windows, h, base)
        if base.fit.objective - found.fit.objective < case.settings.levels.gain_least:
            continue
        found = again(case, found, own_floor(case, found))
        if gone := withdrawn(case, found, claimed):
            return gone
    return set()


def withdrawn(case: LevelCase, top: Simulated, claimed: Sequence[Candidate]) -> set[str]:
    """Effects claimed from the modes of one level that vanish beside those that the hits show.

    Friction that locks acts at one level as a damper does. Fitted together, the friction leaves nothing to the damper.
    """
    if not any(depends_on_level(x, case.library) for x in top.hypothesis.labels):
        return set()
    gone = set()
    for c in claimed:
        for p in case.parameters_of(c.label):
            before, name = c.parameters.get(p.name), f"{c.label}.{p.name}"
            if before is None or name not in top.values or not np.isfinite(p.null):
                continue
            value, std = top.values[name], top.std[name]
            vanished = abs(value - p.null) < _NOTHING_LEFT * std
            moved = abs(value - before.value) > _ELSEWHERE * np.hypot(std, before.std)
            if vanished and moved:
                gone.add(c.label)
    return gone


def without(linear: Diagnosis, labels: set[str]) -> Diagnosis | None:
    """The diagnosis of one level without some of its claims; None where nothing is left of them."""
    kept = tuple(replace(c, claimed=c.claimed and c.label not in labels) for c in linear.candidates)
    return replace(linear, candidates=kept) if any(c.claimed for c in kept) else None


def without_time_response(
    rig: Rig,
    configurations: Sequence[str],
    labels: Sequence[str],
    settings: DiagnoseSettings,
    library: Library | None,
) -> set[str]:
    """Effects with which no hit can be simulated: a loss factor holds at steady state only."""
    found = set()
    for label in labels:
        hypothesis = Hypothesis((label,))
        made = make_rig(rig, hypothesis, library, settings.parameter_range)
        at = starting_points(extras(rig, hypothesis, library))[0]
        if any(np.any(made.assembly(c, at).system().structural) for c in configurations):
            found.add(label)
    return found
