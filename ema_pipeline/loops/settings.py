"""Settings of the isolator identification."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from ema_pipeline.settings import Settings


class LoopSettings(Settings):
    """How loops are measured and fitted."""

    points_per_cycle: int = Field(256, ge=32, le=2048, description="points of an averaged loop")
    displacement_harmonics: int = Field(
        9, ge=1, le=50, description="harmonics by which the noise of the displacement is smoothed"
    )
    frequency_search: float = Field(
        0.03, ge=0, lt=0.3, description="the true frequency is sought within this share of the stated one"
    )
    steady_tolerance: float = Field(
        0.03, gt=0, lt=0.5, description="cycles within this share of the largest amplitude are steady"
    )
    amplitude_tolerance: float = Field(
        0.2, gt=0, description="largest difference between the stated and the measured amplitude"
    )
    own_scales: Literal["auto", "yes", "no"] = Field(
        "auto",
        description="whether each loop has a force scale of its own, as tests at several tensions need; 'auto': "
        "where loops of one frequency and amplitude differ",
    )
    significance: float = Field(
        2.0, gt=0, description="standard deviations from which a value counts as different from zero"
    )
