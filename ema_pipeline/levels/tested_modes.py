"""Every mode at every level, and whether it moves: levels tell how far, single hits tell how surely."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.tracks import only, trusted
from ema_pipeline.levels.types import ForceLevel, HitModes, ModeLevels

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import HitSamples
    from ema_pipeline.levels.single import HitPoles
    from ema_pipeline.modal.types import ModalModel

Hits = Callable[[], "Iterable[HitSamples]"]
Real = NDArray[np.float64]
Integers = NDArray[np.int64]

FAR = 0.5
"""Change of a frequency, in half-power half-widths, beyond which hits are no small change from their mean: they
tell that it moves, the levels' own FRFs tell how far, and nothing is claimed of the damping."""


def tested_modes(
    modal: ModalModel,
    levels: Sequence[ForceLevel],
    hits: Hits,
    frfs: FrfSet,
    frf_settings: FrfSettings,
    place: dict[str, int],
    settings: LevelSettings,
    one_at_least: bool,
) -> tuple[tuple[ModeLevels, ...], float, HitModes | None]:
    """The modes of a model with their tests, those that move if any does, the p value of all tests, and every hit's."""
    from ema_pipeline.levels.hit_trends import hit_trends
    from ema_pipeline.levels.sentences import trend_words
    from ema_pipeline.levels.single import single_hits
    from ema_pipeline.levels.trend import clearest, shifts

    modes = _modes(modal, levels, len(frfs.inputs))
    base = trusted(modal, modes)
    if not len(base):
        return modes, float("nan"), None
    found = single_hits(hits, only(modal, base), frfs, frf_settings)
    level = np.array([place[name] for name in found.names], dtype=np.int64)
    changes = [_far(modes[k]) for k in base]
    tests = hit_trends(found, level, np.array(changes) != 0)
    frequency, damping, size = tests.frequency, tests.damping, tests.size
    moves = clearest(tests.p_values, settings.false_alarm, one_at_least)
    out = list(modes)
    for r, k in enumerate(base):
        both = bool(moves[r]), bool(moves[r + len(base)])
        grows = bool(moves[r + 2 * len(base)])
        slope, far = frequency[r].slope, changes[r]
        shift = shifts(
            found.frequency_hz[:, r], found.frequency_std_hz[:, r], found.sheet, level, frequency[r]
        )
        damping_shift = shifts(
            found.damping_ratio[:, r], found.damping_std[:, r], found.sheet, level, damping[r]
        )
        if far:
            both, slope = (any(both), False), far
            shift = _differences(modes[k].frequency_hz, modes[k].frequency_std_hz)
            damping_shift = _differences(modes[k].damping_ratio, modes[k].damping_std)
        out[k] = replace(
            modes[k] if far else _with_scatter(modes[k], found, level, r),
            amplitude_m=_amplitudes(found, level, r, modes[k].amplitude_m.shape),
            frequency_p=frequency[r].p,
            damping_p=damping[r].shown_p,
            depends=any(both) or grows,
            trend=trend_words(both[0], slope, both[1], damping[r].slope, grows, size[r].slope),
            frequency_shift_hz=shift[0],
            frequency_shift_std_hz=shift[1],
            damping_shift=damping_shift[0],
            damping_shift_std=damping_shift[1],
            size=tests.level_sizes[r][0],
            size_std=tests.level_sizes[r][1],
            size_p=size[r].shown_p,
        )
    return tuple(out), tests.p_value, _hit_modes(found, base, level, modal, frfs)


def _modes(modal: ModalModel, levels: Sequence[ForceLevel], n_inputs: int) -> tuple[ModeLevels, ...]:
    """Every mode of the configuration at every level."""
    from ema_pipeline.levels.tracks import assign, follow, mode_at

    models = [level.modal for level in levels if level.modal is not None]
    tracks = follow(models)
    lost = np.full(len(models), -1, dtype=np.int64)
    out = []
    for index, t in enumerate(assign(modal, models, tracks)):
        track = tracks[t] if t >= 0 else lost
        values = np.full((4, len(models)), np.nan)
        for k in range(len(models)):
            mode = mode_at(models, track, k)
            if mode is not None:
                values[:, k] = (
                    mode.frequency_hz, mode.frequency_std_hz, mode.damping_ratio, mode.damping_std,
                )  # fmt: skip
        out.append(
            ModeLevels(
                mode=index,
                frequency_hz=values[0],
                frequency_std_hz=values[1],
                damping_ratio=values[2],
                damping_std=values[3],
                amplitude_m=np.full((len(models), n_inputs), np.nan),
                frequency_p=float("nan"),
                damping_p=float("nan"),
                depends=False,
                trend="",
                level_modes=track,
            )
        )
    return tuple(out)


def _hit_modes(found: HitPoles, base: Integers, level: Integers, modal: ModalModel, frfs: FrfSet) -> HitModes:
    """What single hits tell, in the form that a comparison with a model needs."""
    from ema_pipeline.levels.single import output_shapes, windows_about

    chosen = only(modal, base)
    axis, poles = frfs.frequency_hz, np.array([m.pole for m in chosen.modes], dtype=np.complex128)
    band = np.zeros((len(base), 2))
    for window in windows_about(poles - frfs.response_decay_rad_s, axis):
        band[window.modes] = axis[window.lines][[0, -1]]
    with np.errstate(invalid="ignore"):
        relative = found.frequency_std_hz / found.frequency_hz
    return HitModes(
        base,
        frfs.outputs,
        output_shapes(frfs, chosen),
        found.names,
        level,
        found.sheet,
        np.log(found.frequency_hz),
        relative,
        found.damping_ratio,
        found.damping_std,
        found.motion_m,
        found.size,
        found.size_std,
        frfs.response_decay_rad_s,
        band,
        float(axis[1] - axis[0]),
        found.pulses,
    )


def _far(mode: ModeLevels) -> float:
    """Change of the frequency, as the levels' own FRFs show it, where that is too far for single hits; 0 elsewhere."""
    change = float(mode.frequency_hz[-1] - mode.frequency_hz[0])
    half_width = float(mode.frequency_hz[0] * mode.damping_ratio[0])
    return change if abs(change) > FAR * half_width else 0.0  # NaN is not


def _differences(values: Real, stds: Real) -> tuple[Real, Real]:
    """Differences from the softest level, and their standard deviations."""
    std = np.hypot(stds, stds[0])
    std[0] = 0.0
    return values - values[0], std


def _with_scatter(mode: ModeLevels, found: HitPoles, level: Integers, r: int) -> ModeLevels:
    """A mode's values at every level with the scatter of hits added; filled in from single hits where missing."""
    frequency = _at_levels(
        mode.frequency_hz, mode.frequency_std_hz, found.frequency_hz[:, r], found.frequency_std_hz[:, r],
        level, found.sheet,
    )  # fmt: skip
    damping = _at_levels(
        mode.damping_ratio, mode.damping_std, found.damping_ratio[:, r], found.damping_std[:, r],
        level, found.sheet,
    )  # fmt: skip
    return replace(
        mode,
        frequency_hz=frequency[0],
        frequency_std_hz=frequency[1],
        damping_ratio=damping[0],
        damping_std=damping[1],
    )


def _at_levels(
    values: Real, stds: Real, single: Real, single_std: Real, level: Integers, sheet: Integers
) -> tuple[Real, Real]:
    """Values and standard deviations at every level, widened where hits scatter by more than their noise."""
    from ema_pipeline.levels.trend import birge_ratio

    values, stds = values.copy(), stds.copy()
    for k in range(len(values)):
        of = (level == k) & np.isfinite(single_std)
        if not of.any():
            continue
        weight = single_std[of] ** -2.0
        scatter = birge_ratio(single[of], single_std[of], sheet[of]) * float(weight.sum() ** -0.5)
        if np.isnan(values[k]):
            values[k], stds[k] = float(np.average(single[of], weights=weight)), scatter
        stds[k] = max(float(stds[k]), scatter)
    return values, stds


def _amplitudes(found: HitPoles, level: Integers, r: int, shape: tuple[int, ...]) -> Real:
    out = np.full(shape, np.nan)
    for k in range(shape[0]):
        for i in range(shape[1]):
            of = (level == k) & (found.point == i)
            if of.any():
                out[k, i] = float(np.median(found.amplitude_m[of, r]))
    return out
