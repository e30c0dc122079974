"""Rungs of a ladder with effects that depend on the force level: errors and misfits of hits, fitted and held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.levels.case import LevelCase, Simulated, error_of
from ema_pipeline.diagnose.levels.problem import NoiseFloor, hit_misfits, residuals
from ema_pipeline.diagnose.levels.rungs import climb
from ema_pipeline.diagnose.levels.search import again, own_floor
from ema_pipeline.diagnose.levels.views import holds, unforeseen, views
from ema_pipeline.diagnose.progress import Progress
from ema_pipeline.diagnose.types import EffectSize, Ladder, Rung, TimeTrace
from ema_pipeline.errors import EmaError

_HELD_OUT_STEPS = 3
_TRACE_SENSORS = 1


@dataclass(frozen=True)
class LevelErrors:
    """How a model fares on hits that it was fitted to, and on levels left out of the fit.

    Attributes
    ----------
    error, heldout_error : float
        Root-mean-square in standard uncertainties.
    misfit, heldout_misfit : ndarray, (n_levels,)
        Normalised time-domain misfit of each level; NaN for a level that cannot be held out.
    """

    error: float
    heldout_error: float
    misfit: NDArray[np.float64]
    heldout_misfit: NDArray[np.float64]


def level_errors(case: LevelCase, model: Simulated, floor: NoiseFloor, hold_out: bool = True) -> LevelErrors:
    """Errors and misfits of a model at its optimum.

    A level's held-out error is that of the prediction by a fit to the other levels: what it adds to their sum of
    squares, an error common to all levels being known from these as far as it can be. It is infinite where that fit
    has no motion at the level left out.
    """
    misfit = _level_misfits(case, model)
    held = np.full(misfit.size, np.nan)
    squares, data = 0.0, 0.0
    for level in case.levels if hold_out and len(case.levels) > 1 else ():
        part = case.without_level(level)
        fitted = again(part, model, floor, _HELD_OUT_STEPS)
        try:
            held[level] = _level_misfits(case, fitted)[level]
            squares += max(_squares(case, fitted, floor) - _squares(part, fitted, floor), 0.0)
        except EmaError:
            squares = np.inf
        data += case.data - part.data
    out = float(np.sqrt(squares / data)) if data else float("nan")
    return LevelErrors(error_of(case, model), out, misfit, held)


def _squares(case: LevelCase, model: Simulated, floor: NoiseFloor) -> float:
    problem = case.problem(model.hypothesis, model.sizes)
    r = residuals(problem, case.weights(floor), problem.space.point(model.values)[None])[0]
    return float(r @ r)


def _level_misfits(case: LevelCase, model: Simulated) -> NDArray[np.float64]:
    """Misfit of all hits of each level together, the hits weighted alike."""
    problem = case.problem(model.hypothesis, model.sizes)
    simulated = problem.simulate(problem.space.point(model.values)[None])
    squares: list[list[float]] = [[] for _ in case.windows[0].force_n]
    for w, s in zip(case.windows, simulated, strict=True):
        for level, m in zip(w.level, hit_misfits(w, s[0]), strict=True):
            squares[int(level)].append(float(m) ** 2)
    return np.array([np.sqrt(np.mean(s)) if s else np.nan for s in squares])


def sizes_of(
    case: LevelCase, model: Simulated, floor: NoiseFloor, names: Sequence[str] | None = None
) -> dict[str, EffectSize]:
    """Fitted parameters with their uncertainties.

    What even this model misses, or cannot foretell, is no noise that averages out over hits and lines: the size of an
    effect is known no better than to that share.
    """
    units = {n: p.unit for n, p in case.problem(model.hypothesis, model.sizes).rig.parameters.items()}
    chosen = model.values if names is None else names
    share = float(np.hypot(floor.own, unforeseen(case, model)))
    missed = {n: share * abs(model.values[n]) for n in model.sizes}
    return {
        n: EffectSize(float(model.values[n]), float(np.hypot(model.std[n], missed.get(n, 0.0))), units[n])
        for n in chosen
    }


def make_rung(
    case: LevelCase, base: Simulated, model: Simulated, errors: LevelErrors, floor: NoiseFloor
) -> Rung:
    """A rung of the ladder."""
    return Rung(
        effects=model.hypothesis.labels,
        error=errors.error,
        heldout_error=errors.heldout_error,
        chi2=model.fit.objective,
        objective=model.fit.objective,
        parameters=sizes_of(case, model, floor),
        log_evidence=float(0.5 * (base.evidence - model.evidence)),
        unexplained=0,
        misfit=tuple(float(v) for v in errors.misfit),
        heldout_misfit=tuple(float(v) for v in errors.heldout_misfit),
    )


def assemble(
    case: LevelCase, models: Sequence[Simulated], floor: NoiseFloor, note: str, tell: Progress
) -> Ladder:
    """The ladder of fitted models, held-out levels included."""
    rungs = []
    for i, m in enumerate(models):
        tell(i / len(models), "predicting held-out levels")
        rungs.append(make_rung(case, models[0], m, level_errors(case, m, floor), floor))
    return Ladder(
        rungs=tuple(rungs),
        frequency_noise=float("nan"),
        damping_noise=float("nan"),
        shape_noise=float("nan"),
        note=note,
        force_n=tuple(float(f) for f in case.windows[0].force_n),
        hit_noise=floor.own,
        traces=time_traces(case, models[0], models[-1]),
        compared_s=max(float(w.time_s[-1]) for w in case.windows) if case.share < 1 else float("nan"),
        left_out=case.left_out,
    )


def make_level_ladder(case: LevelCase, effects: Sequence[str], tell: Progress) -> Ladder:
    """The ladder that adds `effects` one after the other, all at the noise level that the best rung leaves.

    Of the first of the `views` in which a rung follows the motion, or in which at least the last one's error is within
    the limit; of all hits where there is none.
    """
    tried: list[tuple[LevelCase, list[Simulated], NoiseFloor]] = []
    for view in views(case, lambda: tried[0][1][-1]):
        models = climb(view, effects, case.floor, lambda share, text: tell(0.5 * share, text))
        floor = own_floor(view, min(models, key=lambda m: m.evidence))
        tell(0.5, "noise level")
        tried.append((view, [again(view, m, floor) for m in models], floor))
        followed = floor.own < case.settings.levels.noise_most
        if followed and (not view.left_out or holds(case, view, tried[-1][1][-1], floor)):
            break
    else:
        within = [t for t in tried if holds(case, t[0], t[1][-1], t[2])]
        tried.append((within or tried)[0])
    view, final, floor = tried[-1]
    return assemble(view, final, floor, "", lambda share, text: tell(0.6 + 0.4 * share, text))


def time_traces(case: LevelCase, before: Simulated, after: Simulated) -> tuple[TimeTrace, ...]:
    """One signal per level: of the hit and sensor where the second model improves most."""
    found: list[TimeTrace] = []
    for w, one, two in zip(case.windows, _signals(case, before), _signals(case, after), strict=True):
        measured, first, last = w.in_band(w.measured), w.in_band(one), w.in_band(two)
        size = np.sqrt(np.mean(measured**2, axis=2))
        gain = np.mean((measured - first) ** 2 - (measured - last) ** 2, axis=2) / np.maximum(size, 1e-12)
        gain = np.where(w.present, gain, -np.inf)
        hit, sensor = np.unravel_index(np.argmax(gain), gain.shape)
        point = str(w.impacts[hit])
        for level in sorted(set(w.level)):
            at = [i for i in range(len(w.names)) if w.level[i] == level and str(w.impacts[i]) == point]
            if not at or not w.present[at[0], sensor]:
                continue
            i, k = at[0], int(sensor)
            found.append(
                TimeTrace(
                    configuration=w.configuration,
                    hit=w.names[i],
                    force_n=float(w.force_n[level]),
                    impact=w.impacts[i],
                    sensor=w.sensors[k],
                    quantity=w.quantities[k],
                    sample_rate_hz=float(w.sample_rate_hz),
                    measured=measured[i, k],
                    before=first[i, k],
                    after=last[i, k],
                )
            )
    return tuple(found)


def _signals(case: LevelCase, model: Simulated) -> list[NDArray[np.float64]]:
    problem = case.problem(model.hypothesis, model.sizes)
    return [s[0] for s in problem.simulate(problem.space.point(model.values)[None])]
