"""The whole study of one configuration, from its hits to what moves with the force."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.choices import NO_CHOICES, Choices
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import DecayCurve, ForceLevel, HitModes, LevelStudy, ModeLevels
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.processes import spread
from ema_pipeline.threads import cores

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import Hit, HitSamples
    from ema_pipeline.levels.single import HitPoles
    from ema_pipeline.modal.circle.settings import CircleSettings
    from ema_pipeline.modal.types import ModalModel

Progress = Callable[[float, str], None]
Hits = Callable[[], "Iterable[HitSamples]"]
Real = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_SIDE_BY_SIDE = 10_000_000
"""Values of all FRFs, 160 MB, above which levels are identified one after the other."""

TRUSTED_VOTES = 0.3
"""Share of model orders that must show a mode which the softest hits do not show."""


FAR = 0.5
"""Change of a frequency, in half-power half-widths, beyond which hits are no small change from their mean: they
tell that it moves, the levels' own FRFs tell how far, and nothing is claimed of the damping."""

PLAIN_CHANGE = 0.1
"""Least change over a decay, in half-power half-widths or of the damping ratio, that is claimed from hits of one
level: smaller ones can be errors of the neighbours that were taken off."""


def levels_of(hits: Sequence[Hit], settings: LevelSettings) -> Integers:
    """Level of every hit, 0 for the softest, (n_hits,)."""
    from ema_pipeline.levels.sort import sort_levels

    return sort_levels(
        [h.impact.point for h in hits], [abs(h.peak_force) for h in hits], settings.level_ratio
    )


def study_levels(
    hits: Hits,
    frfs: FrfSet,
    modal: ModalModel,
    settings: LevelSettings,
    frf_settings: FrfSettings,
    modal_settings: ModalSettings,
    progress: Progress,
    choices: Choices = NO_CHOICES,
    processes: int | None = None,
) -> LevelStudy:
    """Follow every mode over the force levels of the hits.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits of the configuration, one after the other; may be called more than once.
    frfs : FrfSet
        Averaged over all hits; their coherence is asked for where there are several levels.
    modal : ModalModel
        Identified from `frfs`.
    settings : LevelSettings
    frf_settings : FrfSettings
        Those that `frfs` were made with.
    modal_settings : ModalSettings
        Those that `modal` was identified with.
    progress : callable
        Called with the share done (0…1) and a word on what is being done.
    choices : Choices, optional
        Modes that the user excluded from `modal` or included; the levels' own modes follow them.
    processes : int, optional
        Most in which levels are identified side by side; left out, one more than there are processors, so that of three
        levels on two none waits. One in any case where FRFs are so many that memory may be short.

    Returns
    -------
    LevelStudy
        Levels from the FRFs of their hits alone; whether a mode moves is decided on single hits, see
        `single.single_hits` and `trend.trends`. Where something moves, the modes are those of the level nearest to
        the linear structure, see `linear`, less what the nonlinearity made, see `harmonics`.
    """
    from ema_pipeline.levels.harmonics import without_products
    from ema_pipeline.levels.linear import linear_level
    from ema_pipeline.levels.sentences import one_level, several_levels
    from ema_pipeline.levels.signs import signs

    kept = [h.hit for h in hits()]
    unit = kept[0].force_unit
    force = np.array([abs(h.peak_force) for h in kept])
    names = tuple(h.label for h in kept)
    place = levels_of(kept, settings)
    n_levels = int(place.max()) + 1
    if n_levels == 1:
        level = ForceLevel(float(np.median(force)), names, unit=unit)
        progress(0.2, "decays of single hits")
        modes, curves, p_value = _from_decays(modal, hits, frfs, settings)
        depends = bool(p_value < settings.false_alarm)
        study = LevelStudy((level,), frfs.inputs, modes, curves, (), depends, p_value, "")
        return replace(study, summary=one_level(study, modal))

    def of_place(k: int) -> ForceLevel:
        chosen = tuple(n for n, p in zip(names, place, strict=True) if p == k)
        level_force = float(np.median(force[place == k]))
        return _level(hits, chosen, level_force, unit, frf_settings, modal_settings, choices)

    progress(0.0, f"modes of {n_levels} force levels")
    found: list[ForceLevel] = []
    for level in spread(of_place, range(n_levels), _at_once(frfs, processes), least=2):
        found.append(level)
        progress(0.7 * len(found) / n_levels, f"modes at {level.force_n:.3g} {level.unit}")
    levels = tuple(found)
    progress(0.7, "modes of single hits")
    level_of = dict(zip(names, place.tolist(), strict=True))

    def tested(
        model: ModalModel, one_at_least: bool
    ) -> tuple[tuple[ModeLevels, ...], float, HitModes | None]:
        return _tested(model, levels, hits, frfs, frf_settings, level_of, settings, one_at_least)

    modes, p_value, hit_modes = tested(modal, one_at_least=True)
    depends = bool(p_value < settings.false_alarm)
    linear: int | None = None
    products: tuple[str, ...] = ()
    if depends and (linear := linear_level(levels, modes, frfs)) is not None:
        if (
            linear == 0
        ):  # friction makes poles of all kinds: there the softest hits do not tell which are modes
            levels, products = without_products(levels, modes, modal)
        modal = levels[linear].modal or modal
        # what was seen to move may have been left out
        modes, _, hit_modes = tested(modal, one_at_least=not products)
    elif not depends:
        modes = tuple(replace(m, depends=False, trend="") for m in modes)
    progress(0.9, "decays of single hits")
    base = _trusted(modal, modes)
    curves = _decays(modal, base, hits, frfs)
    verdicts = signs(levels, frfs, _only(modal, base)) if len(base) else ()
    study = LevelStudy(
        levels, frfs.inputs, modes, curves, verdicts, depends, p_value, "", linear, products, hit_modes
    )
    return replace(study, summary=several_levels(study, modal, settings))


def _at_once(frfs: FrfSet, processes: int | None) -> int:
    """Levels that are identified at a time: one more than there are processors, so that each is busy to the end."""
    if frfs.frf.size > MOST_SIDE_BY_SIDE or cores() < 2:
        return 1
    return processes or cores() + 1


def with_circles(study: LevelStudy, settings: CircleSettings) -> LevelStudy:
    """The study with circle fits beside the modes of the level that stands for the linear structure."""
    from ema_pipeline.modal.circle import attach_circles

    if study.linear_level is None:
        return study
    levels = list(study.levels)
    level = levels[study.linear_level]
    if level.modal is not None:
        levels[study.linear_level] = replace(level, modal=attach_circles(level.frfs, level.modal, settings))
    return replace(study, levels=tuple(levels))


def _level(
    hits: Hits,
    names: tuple[str, ...],
    force_n: float,
    unit: str,
    frf_settings: FrfSettings,
    modal_settings: ModalSettings,
    choices: Choices,
) -> ForceLevel:
    """FRFs and modes of some of the hits alone."""
    from ema_pipeline.frf.estimate import estimate_frfs
    from ema_pipeline.modal.chosen import chosen, wanted
    from ema_pipeline.modal.identify import identify

    some = (h for h in hits() if h.hit.label in names)
    frfs = estimate_frfs(some, frf_settings)
    asked = wanted(choices.included_modes, frfs.response_decay_rad_s)
    modal = chosen(identify(frfs, modal_settings, wanted=asked), choices)
    return ForceLevel(force_n, names, frfs, modal, unit)


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


def _tested(
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
    base = _trusted(modal, modes)
    if not len(base):
        return modes, float("nan"), None
    found = single_hits(hits, _only(modal, base), frfs, frf_settings)
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


def _hit_modes(found: HitPoles, base: Integers, level: Integers, modal: ModalModel, frfs: FrfSet) -> HitModes:
    """What single hits tell, in the form that a comparison with a model needs."""
    from ema_pipeline.levels.single import output_shapes, windows_about

    chosen = _only(modal, base)
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


def _trusted(modal: ModalModel, modes: Sequence[ModeLevels]) -> Integers:
    """Modes that the softest hits show, and others that are plain and no echo of these."""
    from ema_pipeline.levels.tracks import echoes

    votes = np.array([m.stability for m in modal.modes])
    soft = np.array([m.level_modes is not None and m.level_modes[0] >= 0 for m in modes], dtype=bool)
    if not len(votes):
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(soft | ((votes >= TRUSTED_VOTES) & ~echoes(modal, soft)))


def _only(modal: ModalModel, chosen: Integers) -> ModalModel:
    return replace(modal, modes=tuple(modal.modes[k] for k in chosen))


def _decays(modal: ModalModel, chosen: Integers, hits: Hits, frfs: FrfSet) -> tuple[DecayCurve, ...]:
    """Decay curves of some modes, numbered as in the whole model."""
    from ema_pipeline.levels.decay import decays

    return tuple(replace(c, mode=int(chosen[c.mode])) for c in decays(hits, frfs, _only(modal, chosen)))


def _from_decays(
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
    curves = _decays(modal, chosen, hits, frfs)
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
