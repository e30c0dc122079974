"""Settings of the study of force levels."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.settings import Settings


class LevelSettings(Settings):
    """How hits are sorted by force, and when a mode counts as moving with it."""

    level_ratio: float = Field(default=1.8, gt=1, description="Least ratio between the forces of two levels.")
    false_alarm: float = Field(
        default=0.01,
        gt=0,
        lt=0.5,
        description="Rate at which a linear structure may be called level-dependent, over all its modes.",
    )
