"""Settings of a simulated test: what is recorded, how, and how well."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Literal

from pydantic import ConfigDict, Field, field_validator

from ema_pipeline.settings import Settings
from ema_pipeline.simulate.imperfections import LEVELS, DriftKind, Imperfections, Level

RecordFormat = Literal["uff", "csv", "hdf5", "mat", "wav", "tdms"]


class SimulationSettings(Settings):
    """How the simulated test is made and recorded."""

    model_config = ConfigDict(strict=False)  # numbers may come as text: "30,100,300"

    hits: int = Field(2, ge=1, description="hits per impact point and force level")
    hits_per_record: int = Field(1, ge=1, description="hits in one continuous record file")
    peak_force_n: tuple[float, ...] = Field((150.0,), min_length=1, description="force levels, N")
    force_spread: float = Field(0.1, ge=0, lt=0.5, description="relative spread (1 σ) of the peak force")
    contact_s: float = Field(6e-4, gt=0, description="duration of the hammer's contact, s")
    sample_rate_hz: float = Field(5120.0, gt=0, description="sample rate, Hz")
    duration_s: float = Field(2.0, gt=0, description="length of the record per hit, s")
    pretrigger_s: float = Field(0.1, gt=0, description="time before the blow, s")
    force_noise_n: float = Field(0.009, ge=0, description="noise of the hammer channel, N rms")
    acceleration_noise: float = Field(0.002, ge=0, description="noise of the accelerometers, m/s² rms")
    offset_v: float = Field(1e-3, ge=0, description="standard deviation of the channels' DC offsets, V")
    converter_bits: int = Field(24, ge=8, le=32, description="resolution of the converter")
    converter_range_v: float = Field(10.0, gt=0, description="the converter carries ± this voltage")
    hammer_sensitivity_mv: float = Field(2.25, gt=0, description="mV/N")
    accelerometer_sensitivity_mv: float = Field(1.00, gt=0, description="mV/(m/s²)")
    scatter: float = Field(
        0.0, ge=0, description="true parameters deviate by this many tolerances (1 σ), at random"
    )
    imperfection: Level = Field(
        "none",
        description="rig and test as in a good or a normal laboratory: part_scatter, calibration, transverse, "
        "aim_deg, drift and damping_scatter at once; each of these can still be given",
    )
    part_scatter: float | None = Field(
        None, ge=0, lt=0.5, description="1 σ of ln stiffness of every spring; masses scatter by a quarter"
    )
    calibration: float | None = Field(
        None, ge=0, lt=0.5, description="1 σ of ln gain of every channel, the hammer's too"
    )
    transverse: float | None = Field(
        None, ge=0, lt=1, description="share of the perpendicular motion that accelerometers read, 1 σ"
    )
    aim_deg: float | None = Field(None, ge=0, lt=45, description="hits off in direction, degrees, 1 σ")
    drift: float | None = Field(
        None, ge=0, lt=0.1, description="relative change of all frequencies from hit to hit, 1 σ"
    )
    drift_kind: DriftKind = Field(
        "independent", description="hits deviate each by itself, or each adds to the last ('walk')"
    )
    damping_scatter: float | None = Field(
        None, ge=0, lt=2, description="1 σ of ln damping ratio from mode to mode"
    )
    double_hits: tuple[str, ...] = Field((), description="hits that bounce: '[configuration:]dof#number'")
    overloads: tuple[str, ...] = Field((), description="hits that clip the hammer channel, written alike")
    format: RecordFormat = Field("uff", description="format of the record files")
    seed: int = Field(0, ge=0, description="seed of all random numbers")
    rig_seed: int | None = Field(
        None,
        ge=0,
        description="seed of what belongs to rig and sensors (parts, damping, gains); that of all where left out. Two "
        "tests with one rig_seed and different seeds are of one rig with one set of sensors",
    )

    @field_validator("peak_force_n")
    @classmethod
    def _levels_apart(cls, levels: tuple[float, ...]) -> tuple[float, ...]:
        """Records are named by their level."""
        named = [f"{level:g}" for level in levels]
        if min(levels) <= 0 or len(set(named)) < len(named):
            raise ValueError(f"levels have to be above 0 N, and each another one: {', '.join(named)}")
        return levels

    @field_validator("peak_force_n", "double_hits", "overloads", mode="before")
    @classmethod
    def _one_or_several(cls, given: object) -> object:
        """One item may be given bare, several as text with commas: ``30,100,300``."""
        if isinstance(given, str):
            return [part.strip() for part in given.split(",") if part.strip()]
        return given if isinstance(given, list | tuple) else [given]

    @property
    def seed_of_rig(self) -> int:
        """Seed of parts, damping and channels."""
        return self.seed if self.rig_seed is None else self.rig_seed

    @property
    def imperfections(self) -> Imperfections:
        """Those of the named level, but for the ones that are given themselves."""
        names = [f.name for f in fields(Imperfections)]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(LEVELS[self.imperfection], **given)
