"""Records in SI units, the hits found in them, and each hit's verdicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.dof import Dof
from ema_pipeline.ingest.defaults import CALIBRATION_STD, TRANSVERSE
from ema_pipeline.lazy_samples import CutSamples, LazySamples

ANY_BAND_HZ = (0.0, float("inf"))


@dataclass(frozen=True)
class Transducer:
    """A sensor as the test's description states it, for the test sheet.

    Attributes
    ----------
    name, quantity, unit : str
    dof : str
        Where it sits; empty for the hammer and for a roving sensor.
    sensitivity_mv : float
        mV per `unit`; NaN where the files hold `unit` already.
    mass_kg : float
    calibration_std, transverse : float
        As in `ResponseChannel`.
    """

    name: str
    quantity: str
    unit: str
    dof: str
    sensitivity_mv: float
    mass_kg: float
    calibration_std: float
    transverse: float


@dataclass(frozen=True)
class ResponseChannel:
    """One response channel of a record.

    Attributes
    ----------
    name : str
        Channel name in the record file.
    dof : Dof
        Where the sensor sits and which way it points.
    quantity : str
        ``"acceleration"``, ``"velocity"`` or ``"displacement"`` (SI: m/s², m/s, m).
    sensor_mass_kg : float
        0 where not stated.
    full_scale : float
        Largest value that the input can carry, SI; ``inf`` where not stated.
    calibration_std : float
        Relative 1 σ of the sensitivity.
    transverse : float
        Transverse sensitivity as a share of the main one, 1 σ.
    """

    name: str
    dof: Dof
    quantity: str
    sensor_mass_kg: float = 0.0
    full_scale: float = float("inf")
    calibration_std: float = CALIBRATION_STD
    transverse: float = TRANSVERSE


@dataclass(frozen=True)
class Record:
    """One record file, scaled to SI.

    Attributes
    ----------
    file : str
        Path relative to the test's folder, as test.toml names it.
    impact : Dof
        Where the hammer strikes.
    sample_rate_hz : float
    force_name : str
        Name of the hammer channel.
    force : ndarray, (n_samples,)
        Force, N (V where `force_calibrated` is false).
    responses : LazySamples or ndarray, (n_channels, n_samples)
        Responses in SI; `LazySamples` are read where they are sliced.
    channels : tuple of ResponseChannel
        One per row of `responses`.
    force_full_scale : float
        Largest force that the input can carry, N; ``inf`` where not stated.
    force_calibrated : bool
        False where the hammer signal is deliberately left in volts: FRFs and shapes are then unscaled.
    window_decay_rad_s : float
        Decay rate of the exponential window that was on force and responses when they were recorded; 0 for none.
    force_calibration_std, force_transverse : float
        Of the hammer, as in `ResponseChannel`.
    part : str
        Set-up (hammer, sensors) of which several make up the test; empty where there is but one.
    band_hz : tuple of float
        Band in which the description lets the record be used.
    """

    file: str
    impact: Dof
    sample_rate_hz: float
    force_name: str
    force: NDArray[np.float64]
    responses: LazySamples | NDArray[np.float64]
    channels: tuple[ResponseChannel, ...]
    force_full_scale: float = float("inf")
    force_calibrated: bool = True
    window_decay_rad_s: float = 0.0
    force_calibration_std: float = CALIBRATION_STD
    force_transverse: float = TRANSVERSE
    part: str = ""
    band_hz: tuple[float, float] = ANY_BAND_HZ


@dataclass(frozen=True)
class Hit:
    """One hit: a stretch of a record, with the verdicts on its quality.

    Attributes
    ----------
    file : str
        Record file.
    number : int
        Number of the hit within its record, counted from 1.
    impact : Dof
        Where the hammer strikes.
    start, stop : int
        Samples ``start:stop`` of the record belong to this hit.
    peak : int
        Sample of the force peak within the record.
    peak_force : float
        Force at the peak, in `force_unit`, with its sign.
    verdicts : tuple of CheckResult
        Outcome of every check that could be made.
    force_unit : str
        ``"N"``, ``"V"`` for an uncalibrated hammer.
    part : str
        As in `Record`.
    """

    file: str
    number: int
    impact: Dof
    start: int
    stop: int
    peak: int
    peak_force: float
    verdicts: tuple[CheckResult, ...] = ()
    force_unit: str = "N"
    part: str = ""

    @property
    def label(self) -> str:
        """As a hit is named where it is left out."""
        return f"{self.file}#{self.number}"

    @property
    def accepted(self) -> bool:
        """True unless a check that rejects the whole hit failed."""
        return not any(v.consequence == "reject_hit" and not v.passes for v in self.verdicts)

    @property
    def undecayed(self) -> tuple[CheckResult, ...]:
        """Verdicts on responses that have not decayed at the end of the record."""
        return tuple(v for v in self.verdicts if v.check == "response decay" and not v.passes)

    @property
    def rings_on(self) -> bool:
        """True where a response has not decayed at the end of the record."""
        return bool(self.undecayed)

    @property
    def rejected_channels(self) -> frozenset[str]:
        """Names of channels that must not be used in this hit."""
        return frozenset(
            v.channel for v in self.verdicts if v.consequence == "reject_channel" and not v.passes
        )

    @property
    def reason(self) -> str:
        """Why the hit is left out; empty for an accepted hit."""
        failed = [v for v in self.verdicts if v.consequence == "reject_hit" and not v.passes]
        return "; ".join(v.message or v.check for v in failed)


@dataclass(frozen=True)
class HitSamples:
    """One hit with its samples, cut from its record.

    Attributes
    ----------
    hit : Hit
    sample_rate_hz : float
    force : ndarray, (n_samples,)
        N, or V for an uncalibrated hammer.
    responses : LazySamples or ndarray, (n_channels, n_samples)
        SI; `LazySamples` are read where they are sliced.
    channels : tuple of ResponseChannel
        One per row of `responses`; channels rejected in this hit are already left out.
    force_calibrated : bool
    window_decay_rad_s : float
        As in `Record`.
    force_name : str
        Name of the hammer channel; empty where unknown.
    force_calibration_std, force_transverse : float
        As in `Record`.
    band_hz : tuple of float
        As in `Record`.
    before : LazySamples, (n_channels, n_before), optional
        What the record holds of the responses before it was cut; None where that is not known.
    """

    hit: Hit
    sample_rate_hz: float
    force: NDArray[np.float64]
    responses: LazySamples | NDArray[np.float64]
    channels: tuple[ResponseChannel, ...]
    force_calibrated: bool = True
    window_decay_rad_s: float = 0.0
    force_name: str = ""
    force_calibration_std: float = CALIBRATION_STD
    force_transverse: float = TRANSVERSE
    band_hz: tuple[float, float] = ANY_BAND_HZ
    before: LazySamples | None = None


def cut_hit(record: Record, hit: Hit) -> HitSamples:
    """Cut a hit out of its record and leave out the channels that its verdicts reject."""
    rejected = hit.rejected_channels
    keep = [i for i, c in enumerate(record.channels) if c.name not in rejected]
    return HitSamples(
        hit=hit,
        sample_rate_hz=record.sample_rate_hz,
        force=record.force[hit.start : hit.stop],
        responses=CutSamples(record.responses, keep, hit.start, hit.stop),
        before=CutSamples(record.responses, keep, 0, hit.start),
        channels=tuple(record.channels[i] for i in keep),
        force_calibrated=record.force_calibrated,
        window_decay_rad_s=record.window_decay_rad_s,
        force_name=record.force_name,
        force_calibration_std=record.force_calibration_std,
        force_transverse=record.force_transverse,
        band_hz=record.band_hz,
    )
