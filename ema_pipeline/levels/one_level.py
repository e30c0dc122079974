"""Hits of one level: only what happens within their decays can tell that a mode depends on the amplitude."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.tracks import TRUSTED_VOTES, only
from ema_pipeline.levels.types import DecayCurve, ModeLevels

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import HitSamples
    from ema_pipeline.modal.types import ModalModel

Hits = Callable[[], "Iterable[HitSamples]"]
Integers = NDArray[np.int64]

PLAIN_CHANGE = 0.1
"""Least change over a decay, in half-power half-widths or of the damping ratio, that is claimed from hits of one
level: smaller ones can be errors of the neighbours that were taken off."""


def from_decays(
    modal: ModalModel, hits: Hits, frfs: FrfSet, settings: LevelSettings
) -> tuple[tuple[ModeLevels, ...], tuple[DecayCurve, ...], float]:
    """What the decays after hits of one level tell: the modes with their tests, the curves, and the p value."""
    from ema_pipeline.levels.decay import decay_trends
    from ema_pipeline.levels.sentences import trend_words
    from ema_pipeline.levels.tracks import doubles, separated
    from ema_pipeline.levels.trend import clearest, combined

    n = len(modal.modes)
    votes = np.array([m.stability for m in modal.modes])
    chosen = np.flatnonzero((votes >= TRUSTED_VOTES) & ~doubles(modal))
    curves = decays_of(modal, chosen, hits, frfs)
    alone = separated(modal)
    read = tuple(c for c in curves if alone[c.mode])
    frequency, damping = decay_trends(read, tuple(range(n)))
    p_values = np.array([t.p for t in (*frequency, *damping)])
    change = np.zeros(2 * n)
    for c in read:
        span = float(np.log(c.amplitude_m.max() / c.amplitude_m.min()))
        mode = modal.modes[c.mode]
        change[c.mode] = abs(frequency[c.mode].slope) * span / (mode.frequency_hz * abs(mode.damping_ratio))
        change[c.mode + n] = abs(damping[c.mode].slope) * span / abs(mode.damping_ratio)
    p_values = np.where(np.isfinite(p_values) & (change < PLAIN_CHANGE), 1.0, p_values)
    p_value = combined(p_values)
    moves = clearest(p_values, settings.false_alarm) & (p_value < settings.false_alarm)
    modes = tuple(
        ModeLevels(
            mode=k,
            frequency_hz=np.array([mode.frequency_hz]),
            frequency_std_hz=np.array([mode.frequency_std_hz]),
            damping_ratio=np.array([mode.damping_ratio]),
            damping_std=np.array([mode.damping_std]),
            amplitude_m=np.full((1, len(frfs.inputs)), np.nan),
            frequency_p=frequency[k].p,
            damping_p=damping[k].p,
            depends=bool(moves[k] or moves[k + n]),
            trend=trend_words(bool(moves[k]), frequency[k].slope, bool(moves[k + n]), damping[k].slope),
            level_modes=np.array([k]),
        )
        for k, mode in enumerate(modal.modes)
    )
    return modes, curves, p_value


def decays_of(modal: ModalModel, chosen: Integers, hits: Hits, frfs: FrfSet) -> tuple[DecayCurve, ...]:
    """Decay curves of some modes, numbered as in the whole model."""
    from ema_pipeline.levels.decay import decays

    return tuple(replace(c, mode=int(chosen[c.mode])) for c in decays(hits, frfs, only(modal, chosen)))
