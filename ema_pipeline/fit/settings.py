"""Settings of the fit."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.correlate.settings import AssumedSettings


class FitSettings(AssumedSettings):
    """How the model's parameters are fitted to measured modes."""

    relative_std_limit: float = Field(
        default=0.5,
        gt=0,
        description="Relative standard deviation above which a free parameter does not count as identified: "
        "beyond 50 % not even its factor of two is known.",
    )
    narrowed: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="A parameter with a tolerance counts as identified where its posterior is narrower than"
        " this "
        "share of the tolerance.",
    )
    sweep_points: int = Field(default=601, ge=50, description="Stiffnesses in a sweep of the error function.")
    flat_depth: float = Field(
        default=0.05,
        gt=0,
        description="Depth (median - least)/least below which the error function counts as flat.",
    )
