"""Hits at several force levels → what moves with the level: frequencies, damping, FRFs."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.levels.settings import LevelSettings
    from ema_pipeline.levels.study import study_levels
    from ema_pipeline.levels.types import ForceLevel, LevelStudy, ModeLevels
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "LevelSettings": "settings",
            "study_levels": "study",
            "ForceLevel": "types",
            "LevelStudy": "types",
            "ModeLevels": "types",
        },
    )

__all__ = ["ForceLevel", "LevelSettings", "LevelStudy", "ModeLevels", "study_levels"]
