"""The whole study of one configuration, from its hits to what moves with the force."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import ForceLevel, LevelStudy, ModeLevels
from ema_pipeline.modal.settings import ModalSettings

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import HitSamples
    from ema_pipeline.modal.types import ModalModel

Progress = Callable[[float, str], None]
Hits = Callable[[], "Iterable[HitSamples]"]
Real = NDArray[np.float64]

ONE_LEVEL = (
    "All hits are about as hard; whether the structure is linear cannot be known from them. "
    "Strike every point at two or three forces, each at least twice the last."
)


def study_levels(
    hits: Hits,
    frfs: FrfSet,
    modal: ModalModel,
    settings: LevelSettings,
    frf_settings: FrfSettings,
    modal_settings: ModalSettings,
    progress: Progress,
) -> LevelStudy:
    """Follow every mode over the force levels of the hits.

    Parameters
    ----------
    hits : callable
        Gives the accepted hits of the configuration, one after the other; may be called more than once.
    frfs : FrfSet
        Averaged over all hits.
    modal : ModalModel
        Identified from `frfs`.
    settings : LevelSettings
    frf_settings : FrfSettings
        Those that `frfs` were made with.
    modal_settings : ModalSettings
        Those that `modal` was identified with.
    progress : callable
        Called with the share done (0…1) and a word on what is being done.
    """
    from ema_pipeline.levels.sort import sort_levels

    found = [(h.hit.impact.point, abs(h.hit.peak_force), f"{h.hit.file}#{h.hit.number}") for h in hits()]
    force = np.array([f for _, f, _ in found])
    place = sort_levels([p for p, _, _ in found], force.tolist(), settings.level_ratio)
    names = [name for _, _, name in found]
    if place.max() == 0:
        level = ForceLevel(float(np.median(force)), tuple(names), frfs)
        return LevelStudy((level,), frfs.inputs, (), (), (), False, float("nan"), ONE_LEVEL)

    levels = []
    for k in range(int(place.max()) + 1):
        progress(0.8 * k / (place.max() + 1), f"modes at {np.median(force[place == k]):.3g} N")
        chosen = tuple(n for n, p in zip(names, place, strict=True) if p == k)
        levels.append(_level(hits, chosen, float(np.median(force[place == k])), frf_settings, modal_settings))
    modes = _modes(modal, levels, len(frfs.inputs))
    return LevelStudy(tuple(levels), frfs.inputs, modes, (), (), False, float("nan"), "")


def _level(
    hits: Hits,
    chosen: tuple[str, ...],
    force_n: float,
    frf_settings: FrfSettings,
    modal_settings: ModalSettings,
) -> ForceLevel:
    """FRFs and modes of some of the hits alone."""
    from ema_pipeline.frf.estimate import estimate_frfs
    from ema_pipeline.modal.identify import identify

    wanted = set(chosen)
    some = (h for h in hits() if f"{h.hit.file}#{h.hit.number}" in wanted)
    frfs = estimate_frfs(some, frf_settings)
    return ForceLevel(force_n, chosen, frfs, identify(frfs, modal_settings))


def _modes(modal: ModalModel, levels: list[ForceLevel], n_inputs: int) -> tuple[ModeLevels, ...]:
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
