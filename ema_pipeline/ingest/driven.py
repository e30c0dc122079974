"""Records of continuous excitation in SI units: measured forces and what the sensors read, checked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.clipping import flat_top_share
from ema_pipeline.ingest.description import ChannelDescription, RecordDescription, TestDescription
from ema_pipeline.ingest.driven_entries import record_name
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.load import RATE_TOLERANCE, ScaledChannels, load_channels
from ema_pipeline.ingest.lost_samples import frozen_stretch
from ema_pipeline.ingest.pulse import noise_of, step_of
from ema_pipeline.ingest.records import ResponseChannel

HELD_OUT = "held_out"

BURSTS = "burst_random"
"""Excitation whose `period_samples` are those of a burst and its rest: bursts differ, so that nothing repeats."""

LEAST_SAMPLES = 256
"""A shorter record of a continuous test has neither a spectrum nor a response worth the name."""

SAME_PERIOD = 0.1
"""Relative difference of the force from one period to the next from which the stated period is none."""

AT_LIMIT = 3
"""Samples in a row at the very limit of a record that no smooth or random signal has."""

_PILED_UP, _OVER_NEXT = 10, 4
"""Samples at the very limit, and how many times those of the next value below it, from which a record is clipped: of a
steady vibration in steps of a converter they are 1.4 times those, of a random one fewer."""

_NEAR_LIMIT, _JUST_BELOW = 0.9, 0.99
"""Shares of the limit above which the next value is looked for, and above which other samples count as it does: a sine
that was computed may reach its amplitude exactly many times, and nearly so a hundred times as often."""

CLIPPED_SHARE = 0.85
"""Share of samples near the top that lie at the very top: 0.5 for smooth peaks, 1 for clipped ones."""

SPIKE = 10.0
"""Size of one sample over the largest other one from which it is no motion: a filtered signal does not rise and fall so
far within two samples, and what moves steadily does not do so once."""


@dataclass(frozen=True)
class ForceChannel:
    """One measured force.

    Attributes
    ----------
    name : str
    dof : Dof
        What it drives, and which way it counts.
    calibration_std : float
        Relative 1 σ of its sensitivity.
    transverse : float
        Transverse sensitivity as a share of the main one, 1 σ.
    calibrated : bool
        False where it is deliberately left in volts.
    """

    name: str
    dof: Dof
    calibration_std: float
    transverse: float
    calibrated: bool = True


@dataclass(frozen=True)
class DrivenRecord:
    """One record of continuous excitation, scaled to SI.

    Attributes
    ----------
    name, file : str
    excitation : str
        As stated; empty where nothing was.
    use : str
        ``"fit"`` or ``"held_out"``.
    sample_rate_hz : float
    forces : tuple of ForceChannel
    force : ndarray, (n_forces, n_samples)
        N, positive along the DOF's point.
    channels : tuple of ResponseChannel
    responses : ndarray, (n_channels, n_samples)
        SI, positive along the DOF's point.
    period : int
        Samples of a period; 0 where it does not repeat.
    frame : int
        Samples of a burst and its rest; 0 where it has none.
    transient : int
        Samples at the start that are left out of errors.
    level : float
        NaN where none is stated.
    first : int
        Sample of the file at which the record begins.
    """

    name: str
    file: str
    excitation: str
    use: str
    sample_rate_hz: float
    forces: tuple[ForceChannel, ...]
    force: NDArray[np.float64]
    channels: tuple[ResponseChannel, ...]
    responses: NDArray[np.float64]
    period: int = 0
    frame: int = 0
    transient: int = 0
    level: float = float("nan")
    first: int = 0

    @property
    def held_out(self) -> bool:
        """True where models are judged by it, not fitted to it."""
        return self.use == HELD_OUT

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.force.shape[1])


def load_driven(test: TestDescription, limits: ReadLimits | None = None) -> Iterator[DrivenRecord]:
    """Load the records of a continuous test one after the other.

    Parameters
    ----------
    test : TestDescription
    limits : ReadLimits, optional
        How large a record file may be.

    Raises
    ------
    EmaError
        Where a file cannot be read or contradicts the description, where a record is too short, clipped or has no
        force, where a stated period is none, and where sample rates differ between the records.
    """
    read: dict[str, ScaledChannels] = {}
    rate = 0.0
    for entry in test.records:
        if entry.file not in read:
            read = {entry.file: load_channels(test, entry, limits)}
        data = read[entry.file]
        if rate and abs(data.sample_rate_hz / rate - 1) > RATE_TOLERANCE:
            raise EmaError(
                f"{test.path_of(entry)}: sample rate {data.sample_rate_hz:.10g} Hz differs from {rate:.10g} Hz "
                "of the other records; put it into a test of its own"
            )
        rate = data.sample_rate_hz
        yield _record(test, entry, data)


def _record(test: TestDescription, entry: RecordDescription, data: ScaledChannels) -> DrivenRecord:
    where = f"{test.path_of(entry)}: record '{record_name(entry)}'"
    part = _part(entry, data, where)
    force = np.stack([_signed(data, c, c.dof, part) for c in test.forces])
    responses = np.stack([_signed(data, c, test.dof_of(c, entry), part) for c in test.responses])
    frame = entry.period_samples or 0 if entry.excitation == BURSTS else 0
    period = 0 if frame else entry.period_samples or 0
    for channel, samples in zip((*test.forces, *test.responses), (*force, *responses), strict=True):
        _check_channel(channel, samples, data.full_scale[channel.name], where)
        _check_frozen(channel, samples, bool(frame), f"{where}, channel '{channel.name}'")
    _check_length(entry, force.shape[1], where)
    if period or frame:
        _check_whole(force, period or frame, where)
    if period:
        _check_period(force, period, where)
    return DrivenRecord(
        name=record_name(entry),
        file=entry.file,
        excitation=entry.excitation or "",
        use=entry.use,
        sample_rate_hz=data.sample_rate_hz,
        forces=tuple(_force(c) for c in test.forces),
        force=force,
        channels=tuple(_response(test, c, entry, data.full_scale[c.name]) for c in test.responses),
        responses=responses,
        period=period,
        frame=frame,
        transient=entry.transient_samples,
        level=float("nan") if entry.level is None else entry.level,
        first=part.start,
    )


def _part(entry: RecordDescription, data: ScaledChannels, where: str) -> slice:
    count = len(next(iter(data.samples.values())))
    first = entry.first_sample or 0
    last = count - 1 if entry.last_sample is None else entry.last_sample
    if last >= count or first >= count:
        key, value = ("last_sample", last) if last >= count else ("first_sample", first)
        raise EmaError(f"{where}: {key} = {value}, but the file holds samples 0 to {count - 1}; correct it")
    return slice(first, last + 1)


def _signed(
    data: ScaledChannels, channel: ChannelDescription, dof: Dof | None, part: slice
) -> NDArray[np.float64]:
    assert dof is not None  # checked with the description
    return np.asarray(dof.sign * data.samples[channel.name][part])


def _force(channel: ChannelDescription) -> ForceChannel:
    assert channel.dof is not None  # checked with the description
    return ForceChannel(
        channel.name, channel.dof, channel.calibration_std, channel.transverse, not channel.uncalibrated
    )


def _response(
    test: TestDescription, channel: ChannelDescription, entry: RecordDescription, full_scale: float
) -> ResponseChannel:
    dof = test.dof_of(channel, entry)
    assert dof is not None  # checked with the description
    return ResponseChannel(
        channel.name,
        dof,
        channel.quantity,
        channel.sensor_mass_kg,
        full_scale,
        channel.calibration_std,
        channel.transverse,
    )


def _check_length(entry: RecordDescription, count: int, where: str) -> None:
    left = count - entry.transient_samples
    if left < LEAST_SAMPLES:
        raise EmaError(
            f"{where}: {count} samples, of which {entry.transient_samples} are transient, leave {max(left, 0)}; "
            f"at least {LEAST_SAMPLES} are needed: record longer"
        )


def _check_channel(
    channel: ChannelDescription, samples: NDArray[np.float64], full_scale: float, where: str
) -> None:
    where = f"{where}, channel '{channel.name}'"
    if np.ptp(samples) == 0.0:
        what = "the force" if channel.quantity == "force" else "the signal"
        raise EmaError(
            f"{where}: {what} is constant ({samples[0]:.4g}); check the cable, or leave the record out"
        )
    top = float(np.max(np.abs(samples)))
    if top >= full_scale * (1 - 1e-6):
        raise EmaError(
            f"{where}: reaches its full scale of {full_scale:.4g} at sample {int(np.argmax(np.abs(samples)))}, so it "
            "is clipped; record again with a larger range"
        )
    flat = flat_top_share(samples, noise_of(samples)) > CLIPPED_SHARE
    if flat or _at_limits(samples) >= AT_LIMIT or _piled_up(samples):
        raise EmaError(
            f"{where}: is clipped at {top:.4g}: its tops are flat; record again with a larger range"
        )
    at, times = _largest_sample(samples)
    if times >= SPIKE and channel.quantity != "force":
        raise EmaError(
            f"{where}: sample {at} is {samples[at]:.4g}, {times:.3g} times the largest other one: a spike, no motion; "
            "record again, or cut it off with first_sample and last_sample"
        )


def _check_frozen(
    channel: ChannelDescription, samples: NDArray[np.float64], bursts: bool, where: str
) -> None:
    """Stretches at one value; a force at 0, or between bursts, rests because nothing drives."""
    start, stop = frozen_stretch(samples, step_of(samples))
    rests = channel.quantity == "force" and (bursts or samples[start] == 0.0)
    if stop > start and not rests:
        raise EmaError(
            f"{where}: stands at {samples[start]:.4g} from sample {start} to {stop - 1}, amid a signal: samples were "
            "lost; export or record again, or cut them off with first_sample and last_sample"
        )


def _largest_sample(samples: NDArray[np.float64]) -> tuple[int, float]:
    """Where a record is furthest from its median, and how many times as far as everywhere else."""
    size = np.abs(samples - np.median(samples))
    others, largest = np.partition(size, -2)[-2:]
    return int(np.argmax(size)), float(largest / others) if others > 0 else float("inf")


def _at_limits(samples: NDArray[np.float64]) -> int:
    """Longest row of samples at the very top or bottom of a record."""
    longest = 0
    for limit in (np.max(samples), np.min(samples)):
        same = np.abs(samples - limit) <= 1e-9 * abs(limit)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
        longest = max(longest, int(np.max(edges[1::2] - edges[::2])))
    return longest


def _piled_up(samples: NDArray[np.float64]) -> bool:
    """True where far more samples share the highest or lowest value than the next one.

    A random signal with power up to half the sample rate is clipped for a sample or two at a time, so that no top of it
    is flat.
    """
    middle = float(np.median(samples))
    for signal in (samples - middle, middle - samples):
        limit = float(np.max(signal))
        _, counts = np.unique(signal[signal >= _NEAR_LIMIT * limit], return_counts=True)
        below = np.count_nonzero((signal >= _JUST_BELOW * limit) & (signal < limit))
        if len(counts) > 1 and counts[-1] >= _PILED_UP and counts[-1] > _OVER_NEXT * max(counts[-2], below):
            return True
    return False


def _check_whole(force: NDArray[np.float64], period: int, where: str) -> None:
    count = force.shape[1]
    if period > count:
        raise EmaError(f"{where}: period_samples = {period}, but it has {count} samples; correct it")
    if count % period:
        raise EmaError(
            f"{where}: period_samples = {period} does not fit {count} samples ({count / period:.3f} periods); "
            "correct it, or cut the record with first_sample and last_sample"
        )


def _check_period(force: NDArray[np.float64], period: int, where: str) -> None:
    if force.shape[1] < 2 * period:
        return
    periods = force.reshape(len(force), -1, period)
    change = periods[:, -1] - periods[:, -2]
    about = periods[:, -1] - np.mean(periods[:, -1], axis=-1, keepdims=True)
    share = float(np.sqrt(np.mean(change**2) / max(np.mean(about**2), 1e-300)))
    if share > SAME_PERIOD:
        raise EmaError(
            f"{where}: period_samples = {period} does not fit: the force differs by {100 * share:.0f} % from one "
            "period to the next; correct it, or remove it where the force does not repeat"
        )


def check_same_sensors(records: Sequence[DrivenRecord]) -> None:
    """Make sure that the sensors of all records sit where those of the first do, as one simulation needs it.

    Raises
    ------
    EmaError
        Names the record whose sensors sit elsewhere.
    """
    first = records[0]
    for r in records:
        if [c.dof.point for c in r.channels] != [c.dof.point for c in first.channels]:
            raise EmaError(
                f"record '{r.name}': its sensors sit elsewhere than those of '{first.name}'; records of one "
                "simulation need the same sensors, put it into a test of its own"
            )
