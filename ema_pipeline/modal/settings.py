"""Settings of the modal stage."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from ema_pipeline.settings import Settings


class ModalSettings(Settings):
    """How modes are identified from FRFs. Every field may be left out."""

    engine: Literal["plscf", "lscf", "sdypy"] = Field(
        default="plscf",
        description="Estimator of the poles: 'plscf' (polyreference LSCF, all references at once; the only "
        "one that can separate both modes of a repeated pole), 'lscf' (common-denominator LSCF), 'sdypy' "
        "(the LSCF of sdypy-EMA, for comparison; slow).",
    )
    low_hz: float | None = Field(
        default=None,
        ge=0,
        description="Lower end of the analysed band, Hz. Left out: the lower end of the band that the hammer "
        "excites, but not below 3 periods per record.",
    )
    high_hz: float | None = Field(
        default=None,
        gt=0,
        description="Upper end of the analysed band, Hz. Left out: the upper end of the band that the hammer "
        "excites, at most 95 % of the Nyquist frequency.",
    )
    max_order: int | None = Field(
        default=None,
        ge=4,
        le=400,
        description="Highest polynomial order per sub-band (half the number of poles per reference). Left "
        "out: chosen from the number of peaks seen in the sub-band; at most half as much again is used, since "
        "higher orders follow noise.",
    )
    polish: bool = Field(
        default=True,
        description="Refine poles by a weighted nonlinear least-squares fit on the FRFs. Off: the poles stay "
        "as the engine gives them, with its bias.",
    )

    repeatability: float = Field(
        default=1e-3,
        ge=0,
        description="Relative standard deviation of natural frequencies from hit to hit that is included in the "
        "intervals of a test with one hit, which cannot show it; with several hits it is estimated. 0.1 % "
        "is the change of one structure between two campaigns.",
    )

    @model_validator(mode="after")
    def _band_is_a_band(self) -> ModalSettings:
        if self.low_hz is not None and self.high_hz is not None and self.low_hz >= self.high_hz:
            raise ValueError(f"low_hz = {self.low_hz:g} must lie below high_hz = {self.high_hz:g}")
        return self
