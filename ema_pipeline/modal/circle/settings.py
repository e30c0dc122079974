"""Settings of the circle fit."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ema_pipeline.settings import Settings


class CircleSettings(Settings):
    """How circles are fitted, compared with the modal model, and used to identify modes alone."""

    channels_per_mode: Annotated[int, Field(ge=1)] | Literal["all"] = Field(
        default=4,
        description="FRFs fitted per mode, those with the largest circle over noise first, or 'all'",
    )
    half_width_bandwidths: float = Field(
        default=1.0,
        gt=0.3,
        le=10,
        description="lines used on either side of a mode, in half-power bandwidths",
    )
    minimum_points: int = Field(
        default=7, ge=5, description="least number of lines used, however narrow the mode"
    )
    remove_neighbours: bool = Field(
        default=True,
        description="subtract the circles of the neighbouring modes in the same FRF before the final fit",
    )
    flag_sigma: float = Field(
        default=3.0, gt=0, description="combined standard deviations beyond which circle and mode disagree"
    )
    frequency_tolerance: float = Field(
        default=0.04,
        ge=0,
        description="disagreement in frequency always allowed, in half-power half bandwidths (ζ·f)",
    )
    damping_tolerance: float = Field(
        default=0.04, ge=0, description="relative disagreement in damping always allowed"
    )
    peak_prominence_db: float = Field(
        default=2.0, gt=0, description="method 'circle': least prominence of a peak of the mode indicator, dB"
    )
    maximum_damping_ratio: float = Field(
        default=0.2, gt=0, lt=1, description="method 'circle': modes with a larger damping ratio are left out"
    )
    maximum_residual: float = Field(
        default=0.2,
        gt=0,
        description="method 'circle': largest rms distance of points from the fitted circle over its radius",
    )
