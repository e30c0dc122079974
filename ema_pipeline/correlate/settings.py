"""Settings of pairing and comparison."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.settings import Settings


class AssumedSettings(Settings):
    """Standard deviations of what comes without one, as a printed table does."""

    frequency_std_assumed: float = Field(
        default=0.01,
        gt=0,
        description="Relative standard deviation of a frequency that comes without one (a printed table).",
    )
    damping_std_assumed: float = Field(
        default=0.2,
        gt=0,
        description="Relative standard deviation of a damping ratio that comes without one.",
    )
    shape_std_assumed: float = Field(
        default=0.05,
        gt=0,
        description="Standard deviation of a shape entry that comes without one, in units of the largest entry.",
    )


class PairingSettings(Settings):
    """When a measured mode and a model mode may be the same."""

    frequency_tolerance: float = Field(
        default=0.3,
        gt=0,
        description="Largest |ln(measured/model)| of a pair. Nominal models of machines are off by 10-30 %.",
    )
    least_mac: float = Field(
        default=0.4, ge=0, lt=1, description="Least MAC of a pair (subspace MAC inside a close group)."
    )
    group_width: float = Field(
        default=0.02,
        ge=0,
        description="Model modes closer than this (relative) form a group, compared by subspace.",
    )
    refusal: float = Field(
        default=1.2,
        gt=0,
        description="Cost above which a mode stays unpaired; the cost is 1 at the frequency tolerance "
        "with a MAC of 1, and 1 at the least MAC with equal frequencies.",
    )
    node_level: float = Field(
        default=0.02,
        ge=0,
        description="A model mode whose share of motion at the sensors (or at the points struck) is below "
        "this, relative to the mode that is seen best, counts as not seen (not excited).",
    )


class CompareSettings(Settings):
    """How differences of FRFs are counted."""

    bands: int = Field(default=12, ge=1, description="Number of bands, equally wide on a logarithmic axis.")
    lines_per_band: int = Field(
        default=60, ge=4, description="FRF lines per band that are compared (evenly picked)."
    )
    frf_floor: float = Field(
        default=0.03,
        ge=0,
        description="Standard uncertainty of an FRF, relative to its modulus: calibration of hammer and "
        "sensor.",
    )
    frf_background: float = Field(
        default=0.01,
        ge=0,
        description="Standard uncertainty of an FRF relative to the root-mean-square of all outputs in the "
        "band: cross-axis sensitivity (1-3 % of the main axis) and modes beyond the band fill "
        "antiresonances and FRFs that symmetry makes zero.",
    )
