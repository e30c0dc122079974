"""Loops left out of a fit and predicted by it: whole amplitudes, whole frequencies, single settings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ema_pipeline.loops.closed_form import SAME_AMPLITUDE
from ema_pipeline.loops.fitting import Fitted, fit, predict
from ema_pipeline.loops.loop_set import LoopSet
from ema_pipeline.loops.types import Loop

SAME_FREQUENCY = 0.02
"""Loops whose frequencies agree to this share are taken as tests at one frequency."""
_FEWEST_GROUPS = 3
_CLEARLY = 0.1


def folds(loops: Sequence[Loop], parts: int, *, settings_differ: bool = False) -> tuple[tuple[int, ...], ...]:
    """Indices of the loops to leave out, fold by fold.

    Parameters
    ----------
    loops : sequence of Loop
    parts : int
        Parts into which loops are dealt where they have neither three amplitudes nor three frequencies.
    settings_differ : bool
        Whether loops of one frequency and amplitude are tests at different settings; each is then left out too.

    Returns
    -------
    tuple of tuple of int
        Each amplitude in turn, each frequency, each setting; empty for a single loop.
    """
    amplitudes = _groups([loop.amplitude_m for loop in loops], SAME_AMPLITUDE)
    frequencies = _groups([loop.frequency_hz for loop in loops], SAME_FREQUENCY)
    found: list[tuple[int, ...]] = []
    for labels in (amplitudes, frequencies):
        if len(set(labels)) >= _FEWEST_GROUPS:
            found += [tuple(np.flatnonzero(labels == g).tolist()) for g in np.unique(labels)]
    if settings_differ:
        cells = list(zip(amplitudes.tolist(), frequencies.tolist(), strict=True))
        found += [(i,) for i, cell in enumerate(cells) if cells.count(cell) > 1]
    if not found and len(loops) > 1:
        parts = min(parts, len(loops))
        found = [tuple(range(part, len(loops), parts)) for part in range(parts)]
    return tuple(f for f in found if len(f) < len(loops))


def heldout_error(loops: LoopSet, fitted: Fitted, left_out: Sequence[Sequence[int]]) -> float:
    """Root-mean-square residual of loops that the fits have not seen, in standard deviations; NaN without folds."""
    total, count = 0.0, 0
    for out in left_out:
        kept = [i for i in range(len(loops.loops)) if i not in out]
        trained = fit(loops.subset(kept), fitted.structure, fitted.values, grid=False)
        unseen = loops.subset(out)
        residual = predict(unseen, trained)
        total += float(residual @ residual)
        count += unseen.freedom
    return float(np.sqrt(total / count)) if count else float("nan")


def settings_differ(loops: Sequence[Loop], significance: float) -> bool:
    """True where loops of one frequency and amplitude lose clearly different energy."""
    for i, one in enumerate(loops):
        for other in loops[:i]:
            alike = (
                abs(one.amplitude_m / other.amplitude_m - 1) < SAME_AMPLITUDE
                and abs(one.frequency_hz / other.frequency_hz - 1) < SAME_FREQUENCY
            )
            apart = abs(one.energy_j - other.energy_j)
            std = float(np.hypot(one.energy_std_j, other.energy_std_j))
            if alike and apart > max(_CLEARLY * abs(one.energy_j), 2 * significance * std):
                return True
    return False


def _groups(values: Sequence[float], tolerance: float) -> np.ndarray:
    """A number for each value; values that agree have the same, (n,)."""
    order = np.argsort(values)
    labels = np.zeros(len(values), dtype=int)
    start = values[order[0]]
    for before, at in pairwise(order):
        new = values[at] > start * (1 + tolerance)
        labels[at] = labels[before] + int(new)
        start = values[at] if new else start
    return labels
