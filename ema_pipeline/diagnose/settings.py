"""Settings of the diagnosis."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.settings import Settings


class DiagnoseSettings(Settings):
    """How missing physics is looked for."""

    fit: FitSettings = Field(
        default=FitSettings(convergence=1e-5, starts_per_decade=1),
        description="How each hypothesis is fitted; its floors cap the noise level.",
    )
    noise_least: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="Least share of the floors of `fit` to which the noise level may be lowered where the "
        "best hypotheses leave less: nobody can promise frequencies to better than 1e-5.",
    )
    null_prior: float = Field(
        default=0.5, gt=0, lt=1, description="Prior probability that nothing is missing."
    )
    parameter_prior: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="Share of the rest that goes to parameters out of tolerance; effects share what is left.",
    )
    parameter_range: float = Field(
        default=30.0,
        gt=1,
        description="Factor by which a parameter out of tolerance may be off, to either side.",
    )
    gain_least: float = Field(
        default=6.0,
        gt=0,
        description="Gain of -2 log posterior below which nothing is claimed, where no calibrated threshold "
        "of the effect's family asks for more.",
    )
    probability_least: float = Field(
        default=0.9,
        gt=0.5,
        lt=1,
        description="Probability of 'something is missing', and of one effect or one group, for a claim.",
    )
    error_limit: float = Field(
        default=1.3,
        gt=1,
        description="Error (root-mean-square in standard uncertainties) up to which a model counts as adequate.",
    )
    unexplained_limit: float = Field(
        default=0.15,
        ge=0,
        lt=1,
        description="Share of measured modes that may stay unexplained by an adequate model.",
    )
    missed_mode: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="Probability that a test misses a mode that its band, sensors and impacts should show.",
    )
    folds: int = Field(default=5, ge=2, le=20, description="Parts that the data are held out in, in turn.")
    most_rungs: int = Field(default=3, ge=1, le=6, description="Most effects that the ladder adds by itself.")
    bootstrap: int = Field(
        default=0,
        ge=0,
        le=10000,
        description="Simulated tests with nothing missing from which this test's own thresholds are read; each "
        "takes about as long as one diagnosis, 0 for the shipped thresholds. What is done is kept, so that an "
        "interrupted run goes on.",
    )
    candidates: int = Field(default=5, ge=1, description="Number of candidates that are reported.")
    processes: int = Field(
        default=2, ge=1, le=64, description="Processes that share the hypotheses; 1 for none but this one."
    )
