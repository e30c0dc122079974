"""Settings of FRF estimation and of the checks on FRFs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ema_pipeline.settings import Settings


class FrfSettings(Settings):
    """How FRFs are estimated from hits, and when they are called good."""

    estimator: Literal["H1", "H2", "Hv"] = Field(
        default="H1", description="H1: noise on the responses; H2: on the force; Hv: on both"
    )
    force_window: Literal["none", "auto"] = Field(
        default="none", description="auto: cosine-tapered window about the force pulse"
    )
    exponential_window: Literal["none", "auto"] | Annotated[float, Field(ge=0)] = Field(
        default="none",
        description="Decay rate of a window on force and responses, rad/s; auto: falls to 1 % at the end of the record",
    )
    variance_dof: int = Field(
        default=16,
        ge=1,
        description="Degrees of freedom of the variance, (hits - 1) × neighbouring lines that it is averaged over",
    )
    band_drop_db: float = Field(
        default=40.0,
        ge=20.0,
        description="Drop of the force autospectrum at which the band ends, dB, unless noise ends it earlier",
    )
    block_samples: int | None = Field(
        default=None,
        ge=64,
        description="Samples of a block of random excitation; left out: a power of two that gives about 12 averages",
    )
    input_coherence: float = Field(
        default=0.99,
        gt=0,
        lt=1,
        description="Coherence between forces, or of one with all others, from which they count as the same signal",
    )
    threads: int = Field(default=2, ge=1, description="Number of threads, each with a block of channels")
    minimum_coherence: float = Field(
        default=0.9,
        gt=0,
        lt=1,
        description="Least coherence, weighted by the FRF's power; judged from 3 hits on",
    )
    negative_driving_point: float = Field(
        default=0.1,
        gt=0,
        lt=1,
        description="Largest share of a driving point's imaginary part that may have the wrong sign",
    )
    reciprocity: float = Field(
        default=0.15, gt=0, description="Largest difference of two reciprocal FRFs, relative to their size"
    )
    repeatability: float = Field(
        default=0.1,
        gt=0,
        description="Largest scatter of the FRFs of single hits, relative to their size; judged from 2 hits on",
    )
