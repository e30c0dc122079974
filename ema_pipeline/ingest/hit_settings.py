"""Settings of hit finding and of the checks on single hits."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from ema_pipeline.settings import Settings


class HitSettings(Settings):
    """How hits are found in records and what a good hit is."""

    trigger_level: float = Field(
        default=0.1,
        gt=0,
        lt=1,
        description="Least force of a hit, relative to the largest in the record",
    )
    trigger_noise: float = Field(
        default=8.0, ge=5, description="Least force of a hit over the noise of the hammer channel"
    )
    minimum_spacing_s: float = Field(
        default=0.1,
        gt=0,
        description="Impacts closer than this, s, or than a quarter of their usual spacing, are one hit",
    )
    pre_trigger_s: float = Field(
        default=0.01, ge=0, description="Time kept before the peak where a recording is cut into hits, s"
    )
    trim: Literal["none", "auto"] = Field(
        default="auto",
        description="auto: records of tests whose responses have not decayed start at the force pulse",
    )
    double_hit: float = Field(
        default=0.025, gt=0, lt=1, description="Second impact over the first above which a hit is rejected"
    )
    overload: float = Field(
        default=0.99,
        gt=0,
        le=1,
        description="Share of full scale above which a channel counts as overloaded",
    )
    residual_response: float = Field(
        default=0.01,
        gt=0,
        description="Largest rms response at the end of the record, relative to its maximum",
    )
    force_drop_db: float = Field(
        default=20.0, gt=0, description="Drop of the force spectrum that ends the usable band, dB"
    )
