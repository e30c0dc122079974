"""Settings of the diagnosis of effects that depend on the force level."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.settings import Settings


class LevelDiagnosisSettings(Settings):
    """How simulated hits are held against measured ones."""

    periods: float = Field(
        default=16.0,
        gt=1,
        description="Length of the windows after the blows, in periods of the lowest mode.",
    )
    most_hits: int = Field(
        default=24, ge=2, description="Hits that are simulated in each configuration, at most."
    )
    points_per_period: float = Field(
        default=12.0, ge=4, description="Steps of the integration per period of the highest mode."
    )
    noise_start: float = Field(
        default=0.03,
        gt=0,
        description="Share of the measured amplitude that a simulation may miss, while hypotheses are searched.",
    )
    noise_least: float = Field(
        default=0.001, gt=0, description="Least value to which this share is lowered by the best hypothesis."
    )
    noise_most: float = Field(
        default=0.1, gt=0, description="Largest value of it at which a model still counts as adequate."
    )
    common_error: float = Field(
        default=0.1,
        ge=0,
        description="Share of the FRF that the linear model may miss alike at every force level.",
    )
    data_per_mode: float = Field(
        default=2.0,
        gt=0,
        description="Independent numbers that one mode in one hit is worth; the sensors see the same motion.",
    )
    gain_least: float = Field(
        default=10.0, gt=0, description="Gain of -2 log posterior below which nothing is claimed."
    )
