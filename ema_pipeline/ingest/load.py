"""Record files to records in SI units; nothing is scaled by a guess, every contradiction is an error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.ingest.description import ChannelDescription, RecordDescription, TestDescription
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.readers import read_raw
from ema_pipeline.ingest.readers.raw import FULL_SCALE, RawChannel, RawRecord, Samples, held_open, split_unit
from ema_pipeline.ingest.records import ANY_BAND_HZ, Record, ResponseChannel, Transducer
from ema_pipeline.ingest.swap import find_swap
from ema_pipeline.lazy_samples import LazySamples
from ema_pipeline.units import Unit, find_unit

MINIMUM_SAMPLES = 64
"""A shorter record holds no hit with a spectrum worth the name."""

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 1e-3, 1e9
"""From one sample in a quarter of an hour, slower than any structure, to the fastest converters."""

SLOWEST_UNSTATED_HZ = 64.0
"""Sample rate up to which times of no stated unit may as well be milliseconds, of 64 kHz."""

LARGEST_VOLTAGE = 1000.0
"""V; inputs for vibration sensors take 10 V, the largest of measuring systems some hundred."""

LARGEST_VALUE = 1e15
"""SI units; far beyond every force and motion, and its square is still far from the largest number."""

SMALLEST_VALUE = 1e-25
"""SI units; a channel of less holds no force or motion that was ever measured, and powers of it vanish in rounding."""

LARGEST_WINDOW = float(-np.log(np.finfo(np.float32).tiny))
"""Decay rate times length of a record; a stronger window leaves at its end what single precision cannot hold."""

RATE_TOLERANCE = 1e-4
"""Relative difference up to which two statements of a sample rate mean the same."""

COARSEST_RATE = 0.01
"""Relative uncertainty from which on rounded time stamps do not tell a sample rate by themselves."""


@dataclass(frozen=True)
class ScaledChannels:
    """The described channels of one record file in SI.

    Attributes
    ----------
    sample_rate_hz : float
    samples : dict
        Channel name to samples (n_samples,) in SI; volts for an uncalibrated force channel.
    full_scale : dict
        Channel name to the largest value that the input can carry, in the same units; ``inf`` if unknown.
    """

    sample_rate_hz: float
    samples: dict[str, NDArray[np.float64]]
    full_scale: dict[str, float]


@dataclass(frozen=True)
class _Source:
    """One described channel of an open record file: its samples times `factor` are in SI."""

    samples: Samples
    factor: float
    full_scale: float

    def scaled(self, start: int = 0, stop: int | None = None) -> NDArray[np.float64]:
        return np.asarray(self.samples[start:stop] * self.factor, dtype=np.float64)


class _ScaledSamples(LazySamples):
    """Responses of one record in SI; each is scaled, and read where its format allows it, when asked for."""

    def __init__(self, sources: list[_Source]) -> None:
        self._sources = sources
        self.shape = (len(sources), sources[0].samples.size)

    def held_open(self) -> AbstractContextManager[None]:
        """The record's file, which holds all channels."""
        return held_open(self._sources[0].samples)

    def read(self, row: int, start: int, stop: int) -> NDArray[np.float64]:
        return self._sources[row].scaled(start, stop)


def load_records(*tests: TestDescription, limits: ReadLimits | None = None) -> Iterator[Record]:
    """Load the records of a hammer test one after the other.

    Parameters
    ----------
    *tests : TestDescription
        One test, or all of its parts, whose records are then named ``part/file``.
    limits : ReadLimits, optional
        How large a record file may be.

    Raises
    ------
    EmaError
        As `load_record`, and where sample rates differ between the records.
    """
    first: Record | None = None
    for test, entry in ((t, e) for t in tests for e in t.records):
        record = load_record(test, entry, limits)
        if test.part:
            record = replace(record, file=f"{test.part}/{record.file}")
        if first is None:
            first = record
        elif abs(record.sample_rate_hz / first.sample_rate_hz - 1) > RATE_TOLERANCE:
            remedy = "record all parts at one rate" if test.part else "put it into a test of its own"
            raise EmaError(
                f"{test.path_of(entry)}: sample rate {record.sample_rate_hz:.10g} Hz differs from "
                f"{first.sample_rate_hz:.10g} Hz of '{first.file}'; {remedy}"
            )
        yield record


def load_record(test: TestDescription, entry: RecordDescription, limits: ReadLimits | None = None) -> Record:
    """Load one record of a hammer test and scale it to SI.

    Parameters
    ----------
    test : TestDescription
        The description that `entry` belongs to.
    entry : RecordDescription
        Which record.
    limits : ReadLimits, optional
        How large its file may be.

    Returns
    -------
    Record
        Force in N (V where deliberately uncalibrated), responses in m/s², m/s or m, scaled when asked for.

    Raises
    ------
    EmaError
        Where the file cannot be read, lacks a channel, is too short, holds values that are no numbers,
        contradicts the description (unit, sensitivity, sample rate, window), or where hammer and response are
        swapped.
    """
    if entry.impact is None:
        raise EmaError(f"{test.file}: record '{entry.file}' has no impact: it is no hammer record")
    rate, sources = _open(test, entry, limits)
    _check_window(test, entry, sources[test.force.name].samples.size / rate)
    hammer, responses = sources[test.force.name], {c.name: sources[c.name] for c in test.responses}
    force = hammer.scaled()
    swap = find_swap(force, {name: source.samples for name, source in responses.items()})
    if swap is not None:
        raise EmaError(
            f"{test.path_of(entry)}: channels '{test.force.name}' and '{swap.channel}' look swapped: "
            f"'{swap.channel}' has 90 % of its energy in {100 * swap.response_share:.2f} % of its samples and on one "
            f"side of zero, as a hammer has, while '{test.force.name}' rings ({100 * swap.force_share:.1f} %); "
            "exchange their names in test.toml"
        )
    channels = []
    for channel in test.responses:
        dof = test.dof_of(channel, entry)
        assert dof is not None, "checked when the description was read"
        channels.append(
            ResponseChannel(
                name=channel.name,
                dof=dof,
                quantity=channel.quantity,
                sensor_mass_kg=channel.sensor_mass_kg,
                full_scale=responses[channel.name].full_scale,
                calibration_std=channel.calibration_std,
                transverse=channel.transverse,
            )
        )
    return Record(
        file=entry.file,
        impact=entry.impact,
        sample_rate_hz=rate,
        force_name=test.force.name,
        force=force,
        responses=_ScaledSamples(list(responses.values())),
        channels=tuple(channels),
        force_full_scale=hammer.full_scale,
        force_calibrated=not test.force.uncalibrated,
        window_decay_rad_s=test.exponential_window_rad_s,
        force_calibration_std=test.force.calibration_std,
        force_transverse=test.force.transverse,
        part=test.part,
        band_hz=ANY_BAND_HZ if test.band_hz is None else test.band_hz,
    )


def _check_window(test: TestDescription, entry: RecordDescription, record_s: float) -> None:
    """Refuse an exponential window that nobody can have applied to a record of this length."""
    stated = test.exponential_window_rad_s
    if stated * record_s > LARGEST_WINDOW:
        raise EmaError(
            f"{test.file}: exponential_window_rad_s = {stated:.3g}: such a window leaves nothing of "
            f"'{entry.file}' at its end ({record_s:.3g} s; at most {LARGEST_WINDOW / record_s:.3g} rad/s); state the "
            "window that was applied, 0 if none"
        )


def load_channels(
    test: TestDescription, entry: RecordDescription, limits: ReadLimits | None = None
) -> ScaledChannels:
    """Load the described channels of one record of any kind of test and scale them to SI.

    Raises
    ------
    EmaError
        As `load_record`, but for what is special to hammer tests.
    """
    rate, sources = _open(test, entry, limits)
    return ScaledChannels(
        rate,
        {name: source.scaled() for name, source in sources.items()},
        {name: source.full_scale for name, source in sources.items()},
    )


def _open(
    test: TestDescription, entry: RecordDescription, limits: ReadLimits | None
) -> tuple[float, dict[str, _Source]]:
    """Sample rate and described channels of a record file, checked."""
    path = test.path_of(entry)
    raw = read_raw(path, limits)
    rate = _sample_rate(test, raw, str(path))
    found = {c.name: _find_channel(c.name, raw, str(path)) for c in test.channels}
    _check_distinct(found, str(path))
    _check_lengths(found, str(path))
    sources = {}
    with held_open(found[test.channels[0].name].samples):
        for channel in test.channels:
            where = f"{path}: channel '{channel.name}'"
            source = found[channel.name]
            samples = np.asarray(source.samples)
            factor, in_volts = _factor(channel, source, where), _in_volts(channel, source)
            _check_finite(samples, rate, where)
            _check_believable(samples, rate, factor, in_volts, where)
            sources[channel.name] = _Source(source.samples, factor, _full_scale(channel))
    return rate, sources


def _sample_rate(test: TestDescription, raw: RawRecord, where: str) -> float:
    stated, found = test.sample_rate_hz, raw.sample_rate_hz
    if stated is None and found is None:
        raise EmaError(f"{where}: states no sample rate; add sample_rate_hz to {test.file}")
    if stated is None and raw.rate_tolerance > COARSEST_RATE:
        raise EmaError(
            f"{where}: its time stamps are too coarse to tell the sample rate ({found:.4g} Hz to within "
            f"{100 * raw.rate_tolerance:.1f} %); add sample_rate_hz to {test.file}"
        )
    if stated is None and found is not None and raw.seconds_assumed and found < SLOWEST_UNSTATED_HZ:
        raise EmaError(
            f"{where}: its times, read as seconds, tell {found:.4g} Hz; write their unit in their name (time_ms) or "
            f"add sample_rate_hz to {test.file}"
        )
    tolerance = max(RATE_TOLERANCE, raw.rate_tolerance)
    if stated is not None and found is not None and abs(found / stated - 1) > tolerance:
        raise EmaError(
            f"{where}: sample rate is {found:.10g} Hz in the file but {stated:.10g} Hz in {test.file}; "
            "correct sample_rate_hz or remove it"
        )
    rate = float(stated if stated is not None else found or 0.0)
    if not LOWEST_RATE_HZ <= rate <= HIGHEST_RATE_HZ:
        source = "the file" if stated is None else str(test.file)
        raise EmaError(
            f"{where}: no recorder has a sample rate of {rate:.4g} Hz, as {source} states; correct it"
        )
    return rate


def _find_channel(name: str, raw: RawRecord, where: str) -> RawChannel:
    for candidate in (name, split_unit(name)[0], name.strip("/").rsplit("/", 1)[-1]):
        if candidate in raw.channels:
            return raw.channels[candidate]
    same = [known for known in raw.channels if known.casefold() == name.casefold()]
    close = did_you_mean(name, raw.channels)
    hint = f"did you mean '{same[0]}'? " if same else f"{close.strip(' ()')}; " if "mean" in close else ""
    why = next((note for note in raw.notes if f"'{name}'" in note or f"/{name}'" in note), None)
    if why is not None:
        raise EmaError(f"{where}: has no channel '{name}': {why}; export it as numbers over time")
    shown = ", ".join(list(raw.channels)[:30])
    more = f" and {len(raw.channels) - 30} more" if len(raw.channels) > 30 else ""
    raise EmaError(
        f"{where}: has no channel '{name}' ({hint}the file holds: {shown}{more}); "
        "correct the name in test.toml"
    )


def _check_distinct(found: dict[str, RawChannel], where: str) -> None:
    """Refuse two names that lead to one channel of the file, which would count as two sensors."""
    names: dict[int, str] = {}
    for name, channel in found.items():
        other = names.setdefault(id(channel), name)
        if other != name:
            raise EmaError(
                f"{where}: '{other}' and '{name}' are one channel of the file; correct the name in test.toml"
            )


def _check_lengths(found: dict[str, RawChannel], where: str) -> None:
    sizes = {name: channel.samples.size for name, channel in found.items()}
    short, long = min(sizes, key=lambda n: sizes[n]), max(sizes, key=lambda n: sizes[n])
    if sizes[short] != sizes[long]:
        raise EmaError(
            f"{where}: channels differ in length ('{short}' {sizes[short]} samples, '{long}' {sizes[long]}); "
            "export them together"
        )
    if sizes[short] < MINIMUM_SAMPLES:
        raise EmaError(
            f"{where}: channel '{short}' has {sizes[short]} samples, at least {MINIMUM_SAMPLES} are needed; "
            "record longer or leave the file out"
        )


def _check_finite(samples: NDArray[np.float64], rate: float, where: str) -> None:
    finite = np.isfinite(samples)
    if not finite.all():
        at = int(np.argmin(finite))
        count = int(finite.size - finite.sum())
        raise EmaError(
            f"{where}: {samples[at]} at sample {at} ({at / rate:.4g} s), {count} such in all; "
            "export the record again or leave it out"
        )


def _check_believable(
    samples: NDArray[np.float64], rate: float, factor: float, in_volts: float | None, where: str
) -> None:
    """Refuse values that no converter can have recorded; a single large one would drown all others."""
    at = int(np.argmax(np.abs(samples)))
    largest = abs(float(samples[at]))
    if in_volts is not None and largest * in_volts > LARGEST_VOLTAGE:
        raise EmaError(
            f"{where}: {samples[at] * in_volts:.4g} V at sample {at} ({at / rate:.4g} s) is more than any "
            f"converter takes ({LARGEST_VOLTAGE:g} V); export the record again or leave it out"
        )
    if largest > LARGEST_VALUE / max(abs(factor), np.finfo(float).tiny):
        raise EmaError(
            f"{where}: {samples[at]:.4g} at sample {at} ({at / rate:.4g} s) is beyond all measurement once scaled "
            f"(factor {factor:.4g}); correct unit and sensitivity_mv, or export the record again"
        )
    if 0 < largest < SMALLEST_VALUE / max(abs(factor), np.finfo(float).tiny):
        raise EmaError(
            f"{where}: {samples[at]:.4g} at sample {at} ({at / rate:.4g} s) is its largest value, below all "
            f"measurement once scaled (factor {factor:.4g}); correct unit and sensitivity_mv, or export it again"
        )


def _in_volts(channel: ChannelDescription, source: RawChannel) -> float | None:
    """Volts of one number of the file; None where it is no voltage, or one in name only (uncalibrated)."""
    if source.unit == FULL_SCALE or channel.sensitivity_mv is None:
        return None
    stated = find_unit(source.unit) if source.unit is not None else None
    return 1.0 if stated is None else stated.scale


def _factor(channel: ChannelDescription, source: RawChannel, where: str) -> float:
    """What one number of the file is in SI (volts for an uncalibrated force)."""
    unit = channel.parsed_unit
    if source.unit == FULL_SCALE:
        return _fraction_factor(channel, unit, where)
    label = source.unit
    # A label that spells no unit we know says nothing that could contradict the description.
    stated = find_unit(label) if label is not None else None
    if channel.sensitivity_mv is not None:
        if stated is not None and stated.quantity != "voltage":
            raise EmaError(
                f"{where}: the file is in '{label}' already, but test.toml gives sensitivity_mv = "
                f"{channel.sensitivity_mv:g} for volts; remove sensitivity_mv, or export volts"
            )
        volts = stated.scale if stated is not None else 1.0
        return volts * 1000.0 / channel.sensitivity_mv * unit.scale
    if channel.uncalibrated:
        if stated is not None and stated.quantity != "voltage":
            raise EmaError(
                f"{where}: is marked uncalibrated, but the file is in '{label}'; "
                f'write unit = "{label}" and remove uncalibrated'
            )
        return stated.scale if stated is not None else unit.scale
    if stated is None:
        return unit.scale
    if stated.quantity == "voltage":
        raise EmaError(
            f"{where}: the file is in '{label}', but test.toml has no sensitivity_mv; "
            f"add the sensor's mV per {channel.unit}"
        )
    if not stated.same_as(unit):
        raise EmaError(
            f"{where}: the file is in '{label}' but test.toml says '{channel.unit}'; "
            "correct unit in test.toml"
        )
    return unit.scale


def _fraction_factor(channel: ChannelDescription, unit: Unit, where: str) -> float:
    """Scale of integer WAV, whose numbers are fractions of the converter's full scale."""
    if channel.sensitivity_mv is not None and channel.full_scale_v is not None:
        return channel.full_scale_v * 1000.0 / channel.sensitivity_mv * unit.scale
    if channel.sensitivity_mv is None and channel.full_scale is not None:
        return channel.full_scale * unit.scale
    if channel.uncalibrated and channel.full_scale_v is not None:
        return channel.full_scale_v
    remedy = (
        "add full_scale_v, the volts at full scale"
        if channel.sensitivity_mv is not None or channel.uncalibrated
        else f"add full_scale_v (volts at full scale) and sensitivity_mv, or full_scale (in {channel.unit})"
    )
    raise EmaError(f"{where}: this WAV holds fractions of full scale; {remedy}")


def _full_scale(channel: ChannelDescription) -> float:
    unit = channel.parsed_unit
    if channel.full_scale is not None:
        return channel.full_scale * unit.scale
    if channel.full_scale_v is None:
        return float("inf")
    if channel.uncalibrated:
        return channel.full_scale_v
    if channel.sensitivity_mv is None:
        return float("inf")
    return channel.full_scale_v * 1000.0 / channel.sensitivity_mv * unit.scale


def transducers_of(tests: Iterable[TestDescription]) -> tuple[Transducer, ...]:
    """The sensors that tests state, each once."""
    found = (_transducer(channel) for test in tests for channel in test.channels)
    return tuple({repr(x): x for x in found}.values())  # by their text: not-a-numbers are never equal


def _transducer(channel: ChannelDescription) -> Transducer:
    return Transducer(
        channel.name,
        channel.quantity,
        channel.unit,
        "" if channel.dof is None else str(channel.dof),
        float("nan") if channel.sensitivity_mv is None else channel.sensitivity_mv,
        channel.sensor_mass_kg,
        channel.calibration_std,
        channel.transverse,
    )
