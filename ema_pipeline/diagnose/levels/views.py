"""Which hits models are held against, and how much of each: where parts strike, not all of it can be foretold."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, error_of
from ema_pipeline.diagnose.levels.problem import NoiseFloor, TimeProblem, objectives
from ema_pipeline.diagnose.levels.rungs import climb
from ema_pipeline.diagnose.levels.search import Growing, again, fit_effect
from ema_pipeline.effects.library import depends_on_level
from ema_pipeline.errors import EmaError

_PARTS = (0.4, 0.16)
"""Shares of the windows that are tried one after the other, until a model holds."""

_NUDGE = 1e-3
"""No record knows the force better than to this share."""

_MOVED = 0.1
"""Share of the motion: a hit whose motion changes by more, see `sensitivity`, is not foretold."""

_ENOUGH = 0.5
"""Share of the hits that must be left."""

_ROUNDS = 4
_MOST_STEPS = 25


def views(case: LevelCase, best: Callable[[], Simulated]) -> Iterator[LevelCase]:
    """All hits; those that a model foretells; shorter and shorter first parts of all.

    Parameters
    ----------
    case : LevelCase
    best : callable
        The model that chooses the hits, asked for where all were not enough.
    """
    yield case
    if (some := settled_view(case, best())) is not None:
        yield some
    yield from map(case.beginning, _PARTS)


def settled_view(case: LevelCase, model: Simulated) -> LevelCase | None:
    """The hits that a model foretells once it is fitted to them alone; None where none or too many are left out.

    The choice after `_ROUNDS` fits stands where it has not settled: `holds` tells whether it may.
    """
    kept: LevelCase | None = None
    for _ in range(_ROUNDS):
        view = foretold_hits(case, model)
        if view is None or (kept is not None and view.left_out == kept.left_out):
            return view
        if not view.left_out:
            return None
        kept, model = view, _fitted_to(view, model)
    return kept


def foretold_hits(case: LevelCase, model: Simulated) -> LevelCase | None:
    """The hits whose motion a model foretells, with what is `unsure` in each; None where these are too few.

    Enough are `_ENOUGH` of all, one in every configuration and two levels. Where parts strike again and again, a
    thousandth of the force decides what comes next.
    """
    try:
        unsure = sensitivity(case, model)
    except EmaError:  # on the edge of what has a solution
        return None
    told = replace(
        case, windows=tuple(replace(w, unsure=u) for w, u in zip(case.windows, unsure, strict=True))
    )
    view = told.only([u <= _MOVED for u in unsure])
    count = [len(w.names) for w in view.windows]
    enough = sum(count) >= _ENOUGH * sum(len(w.names) for w in case.windows)
    return view if enough and min(count) > 0 and len(view.levels) > 1 else None


def holds(case: LevelCase, view: LevelCase, model: Simulated, floor: NoiseFloor) -> bool:
    """True where the error of a model fitted to a view is within the limit, in all hits that this model foretells.

    Hits may be left out only by the model that says why they cannot be foretold.
    """
    limit = case.settings.error_limit
    if not error_of(view, model) <= limit:
        return False
    if not view.left_out:
        return True
    every = foretold_hits(case, model)
    if every is None:
        return False
    problem = every.problem(model.hypothesis, model.sizes)
    objective = objectives(problem, every.weights(floor), problem.space.point(model.values)[None])[0]
    return error_of(every, replace(model, fit=replace(model.fit, objective=float(objective)))) <= limit


def sensitivity(case: LevelCase, model: Simulated) -> list[NDArray[np.float64]]:
    """Share by which the motion after each hit changes where the force, or the step of the integration, hardly does.

    That is, beyond proportion where the force is `_NUDGE` larger, and where the step is half as long: the root of the
    sum of both squares.

    Returns
    -------
    list of ndarray, (n_hits,)
        By configuration; root-mean-square over all sensors.
    """
    problem = case.problem(model.hypothesis, model.sizes)
    x = problem.space.point(model.values)[None]
    louder = [replace(w, force=(1 + _NUDGE) * w.force) for w in case.windows]
    plain, nudged, finer = (
        TimeProblem(problem.rig, windows, substeps).simulate(x)
        for windows, substeps in (
            (case.windows, problem.substeps),
            (louder, problem.substeps),
            (case.windows, 2 * problem.substeps),
        )
    )
    found = []
    for w, one, more, fine in zip(case.windows, plain, nudged, finer, strict=True):
        before = w.in_band(one[0]) * w.present[..., None]
        apart = (w.in_band(more[0]) / (1 + _NUDGE), w.in_band(fine[0]))
        moved = sum((x * w.present[..., None] - before) ** 2 for x in apart)
        found.append(np.sqrt(np.sum(moved, axis=(1, 2)) / np.sum(before**2, axis=(1, 2))))
    return found


def unforeseen(case: LevelCase, model: Simulated) -> float:
    """Share of the motion that a model does not foretell, over all hits; none counts for more than `_MOVED`."""
    if not any(depends_on_level(x, case.library) for x in model.hypothesis.labels):
        return 0.0
    try:
        shares = np.concatenate(sensitivity(case, model))
    except EmaError:  # on the edge of what has a solution
        return _MOVED
    return float(np.sqrt(np.mean(np.minimum(shares, _MOVED) ** 2)))


def _fitted_to(view: LevelCase, model: Simulated) -> Simulated:
    """The model at its best on some of the hits, sought anew and from where it was."""
    floor, labels = view.floor, model.hypothesis.labels
    found = [again(view, model, floor)]
    if labels and depends_on_level(labels[-1], view.library):
        base = climb(view, labels[:-1], floor, lambda share, text: None)[-1]
        found.append(fit_effect(Growing(view, floor, base), model.hypothesis, base))
    best = min(found, key=lambda m: m.fit.objective)
    return again(view, again(view.coarse(), best, floor, _MOST_STEPS), floor)
