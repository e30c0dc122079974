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
from ema_pipeline.levels.types import ForceLevel, HitModes, LevelStudy, ModeLevels
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.processes import spread
from ema_pipeline.threads import cores

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import Hit, HitSamples
    from ema_pipeline.modal.circle.settings import CircleSettings
    from ema_pipeline.modal.types import ModalModel

Progress = Callable[[float, str], None]
Hits = Callable[[], "Iterable[HitSamples]"]
Real = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_SIDE_BY_SIDE = 10_000_000
"""Values of all FRFs, 160 MB, above which levels are identified one after the other."""


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
    from ema_pipeline.levels.harmonics import without_faint, without_products
    from ema_pipeline.levels.linear import linear_level
    from ema_pipeline.levels.one_level import decays_of, from_decays
    from ema_pipeline.levels.sentences import one_level, several_levels
    from ema_pipeline.levels.signs import signs
    from ema_pipeline.levels.tested_modes import tested_modes
    from ema_pipeline.levels.tracks import only, trusted

    kept = [h.hit for h in hits()]
    unit = kept[0].force_unit
    force = np.array([abs(h.peak_force) for h in kept])
    names = tuple(h.label for h in kept)
    place = levels_of(kept, settings)
    n_levels = int(place.max()) + 1
    if n_levels == 1:
        level = ForceLevel(float(np.median(force)), names, unit=unit)
        progress(0.2, "decays of single hits")
        modes, curves, p_value = from_decays(modal, hits, frfs, settings)
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
        return tested_modes(model, levels, hits, frfs, frf_settings, level_of, settings, one_at_least)

    modes, p_value, hit_modes = tested(modal, one_at_least=True)
    depends = bool(p_value < settings.false_alarm)
    linear: int | None = None
    products: tuple[str, ...] = ()
    if depends and (linear := linear_level(levels, modes, frfs)) is not None:
        if linear == 0:
            levels, products = without_products(levels, modes, modal)
        else:
            levels, products = without_faint(levels, linear)
        modal = levels[linear].modal or modal
        # what was seen to move may have been left out
        modes, _, hit_modes = tested(modal, one_at_least=not products)
    elif not depends:
        modes = tuple(replace(m, depends=False, trend="") for m in modes)
    progress(0.9, "decays of single hits")
    base = trusted(modal, modes)
    curves = decays_of(modal, base, hits, frfs)
    verdicts = signs(levels, frfs, only(modal, base)) if len(base) else ()
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
