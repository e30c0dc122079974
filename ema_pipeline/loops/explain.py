"""A diagnosis of loops in plain sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ema_pipeline.loops.effects import DISSIPATIVE
from ema_pipeline.loops.fitting import Fitted
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.search import Ranking
from ema_pipeline.loops.types import LoopModel
from ema_pipeline.loops.visible import Limit, best_loop
from ema_pipeline.loops.words import failures

_TOLD = 2.0
_FIRST_SHARE = 0.34


def where_it_falls(loops: LoopSet, before: Fitted, after: Fitted, signs: str) -> str:
    """Two sentences: the effect's tell-tale signs, and the loops whose misfit falls most."""
    fall = before.residual**2 - after.residual**2
    by_loop = [float(np.sum(fall[part])) for part in loops.parts]
    total = float(np.sum(fall))
    if total <= 0:
        return f"Its signs: {signs}. No loop is fitted better with it."
    order = np.argsort(by_loop)[::-1][:2]
    names = " and ".join(loops.loops[i].name for i in order if by_loop[i] > 0)
    motion = loops.motion
    near = motion.way < _FIRST_SHARE * motion.span
    share = float(np.sum(fall[near])) / total
    where = f", {100 * share:.0f} % of it in the third after each reversal" if 0 < share < 1 else ""
    return f"Its signs: {signs}. The misfit falls most at {names}{where}."


def scales_words(loops: LoopSet, fitted: Fitted) -> tuple[str, ...]:
    """Which loops stand for other settings of the device."""
    if not loops.own_scale:
        return ()
    scales = fitted.scales
    text = ", ".join(f"{one.name} {s:.2f}" for one, s in zip(loops.loops, scales, strict=True))
    ratio = float(scales.max() / scales.min())
    return (
        "loops of one frequency and amplitude differ in force, so they are tests of one device at several "
        f"settings (e.g. tensions): each has a force scale of its own, over a range of 1 : {ratio:.2g} ({text}); "
        "loops held out get only their scale and offset from their own data",
    )


def play_words(fitted: Fitted) -> tuple[str, ...]:
    """Whose play it is."""
    if "backlash" not in fitted.structure.effects or not set(fitted.structure.effects) & set(DISSIPATIVE):
        return ()
    if fitted.structure.spring_play:
        return ("the free play is that of the spring alone: damping goes on while the spring is idle",)
    return ("the free play is that of the whole isolator: nothing damps while it is run through",)


def missing_words(loops: LoopSet, model: LoopModel, error: float, limit: float) -> tuple[str, ...]:
    """What the best model does not show, where it fails."""
    if error <= limit:
        return ()
    play = any(e.startswith("backlash@") for e in model.effects)
    words = failures(loops.loops, model.fits, model.fits, error, has_play=play, own_scales=bool(model.scales))
    return tuple(f"still missing: {text}" for text in words)


def limits_words(limits: Sequence[Limit]) -> tuple[str, ...]:
    """The smallest effects that the loops would show."""
    if not limits:
        return ()
    shown = [one for one in limits if one.share <= 1]
    hidden = [one.effect.replace("_", " ") for one in limits if one.share > 1]
    texts = [f"beside what the model has, these loops cannot show {' or '.join(hidden)}"] if hidden else []
    if not shown:
        return tuple(texts)
    parts = [
        f"{one.effect.replace('_', ' ')} {one.size:.2g} {one.unit}{f' {one.note}' if one.note else ''} "
        f"({100 * one.share:.2g} % of the force)"
        for one in shown
    ]
    return (
        *texts,
        f"smallest further effects that these loops would show in 19 of 20 tests: {'; '.join(parts)}",
    )


def next_loop(ranking: Ranking, verdict: str, pair: tuple[Fitted, Fitted, str] | None) -> str:
    """The loop that would tell two models apart, or what else to do."""
    frequencies = [loop.frequency_hz for loop in ranking.loops.loops]
    if pair is not None:
        true, other, what = pair
        option = best_loop(ranking.loops, true, other, ranking.widening)
        what = what.replace("_", " ")
        if option.separation < _TOLD:
            return (
                f"No single further loop that was tried would tell {what}; average more cycles of each loop."
            )
        return (
            f"A loop at {option.frequency_hz:.3g} Hz and {1e3 * option.amplitude_m:.3g} mm would tell {what}: "
            f"expected difference {option.separation:.2g} σ."
        )
    if verdict == "unknown_effect":
        if max(frequencies) < 1.02 * min(frequencies):
            return (
                f"Repeat the loops at {0.5 * min(frequencies):.3g} and at {2 * max(frequencies):.3g} Hz: what stays "
                "is friction or play, what changes depends on the rate. Ten cycles or more of each loop would tell "
                "scatter from what repeats."
            )
        return (
            "Repeat one loop about another mean position, and record ten cycles or more of each: what moves with "
            "the position is geometry, what stays is the material."
        )
    if verdict == "not_enough_data":
        return "Record loops at two more amplitudes and two more frequencies."
    return ""
