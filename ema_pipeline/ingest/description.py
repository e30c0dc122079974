"""The test description: what ``test.toml`` says about channels, records and the rig's configuration."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.defaults import CALIBRATION_STD, TRANSVERSE
from ema_pipeline.ingest.driven_entries import check_driven_test
from ema_pipeline.ingest.record_entries import check_records
from ema_pipeline.names import check_name
from ema_pipeline.plain_text import has_control_characters
from ema_pipeline.settings import FirstLayout, Settings, parse
from ema_pipeline.toml_text import read_toml
from ema_pipeline.units import SI_SYMBOL, Unit, parse_unit

DESCRIPTION_FILE = "test.toml"
RIG_FILE = "rig.toml"

_LONGEST_TEXT = 1000
"""Characters of a title or name."""

Quantity = Literal["force", "acceleration", "velocity", "displacement"]

Excitation = Literal["random", "burst_random", "multisine", "chirp", "sweep", "periodic"]


def _parse_dof(value: Any) -> Dof:
    if isinstance(value, Dof):
        return value
    if not isinstance(value, str):
        raise ValueError("a dof is text of the form body.direction, e.g. 'sun.x'")
    try:
        return Dof.parse(value)
    except EmaError as error:
        raise ValueError(str(error)) from None


_HEAVIEST_SENSOR_KG = 2.0
"""Seismic accelerometers, the heaviest sensors in use, have less than 1 kg."""


def _check_sensor_mass(value: float) -> float:
    if not 0 <= value <= _HEAVIEST_SENSOR_KG:
        raise ValueError(f"give the sensor's mass in kg, 0 to {_HEAVIEST_SENSOR_KG:g}, e.g. 0.005 for 5 g")
    return value


DofText = Annotated[Dof, BeforeValidator(_parse_dof)]


def _check_share(value: float) -> float:
    if not 0 <= value < 1:
        raise ValueError("give a share from 0 to below 1, e.g. 0.02 for 2 %")
    return value


Share = Annotated[float, AfterValidator(_check_share)]
SensorMass = Annotated[float, AfterValidator(_check_sensor_mass)]


def _iso_date(value: Any) -> Any:
    if isinstance(value, dt.date):  # a date and time is one, too
        return value.isoformat()
    try:
        return dt.datetime.fromisoformat(value).date().isoformat() if len(value) == 10 else _iso_time(value)
    except (TypeError, ValueError):
        raise ValueError("give a date as 2025-03-31, or a date and time as 2025-03-31T14:05:00") from None


def _iso_time(value: str) -> str:
    return dt.datetime.fromisoformat(value).isoformat()


DateText = Annotated[str, BeforeValidator(_iso_date)]


class ChannelDescription(Settings):
    """One ``[[channels]]`` table: a column, dataset or channel of the record files."""

    name: str = Field(
        min_length=1, description="CSV column, HDF5 dataset, MAT variable, TDMS channel, UFF58 id1"
    )
    quantity: Quantity = Field(description="What the sensor measures")
    unit: str = Field(description="Engineering unit of the channel")
    sensitivity_mv: float | None = Field(
        default=None, gt=0, description="mV per unit; left out: the file is in `unit` already"
    )
    dof: DofText | None = Field(default=None, description="Where and which way; '-' in front for reversed")
    sensor_mass_kg: SensorMass = Field(default=0.0, description="Mass of the sensor")
    full_scale: float | None = Field(
        default=None, gt=0, description="Largest value that the input can carry, in `unit`"
    )
    full_scale_v: float | None = Field(
        default=None, gt=0, description="Largest voltage that the converter can carry"
    )
    calibration_std: Share = Field(default=CALIBRATION_STD, description="Relative 1 sigma of the sensitivity")
    transverse: Share = Field(
        default=TRANSVERSE, description="Transverse sensitivity as a share of the main one, 1 sigma"
    )
    uncalibrated: bool = Field(
        default=False, description="Force channel left in volts on purpose: FRFs and shapes are unscaled"
    )

    @property
    def parsed_unit(self) -> Unit:
        """The channel's unit, looked up."""
        return parse_unit(self.unit, (self.quantity, "voltage"))


class RecordDescription(Settings):
    """One ``[[records]]`` table: a record file, and what was done while it was recorded."""

    file: str = Field(min_length=1, description="Record file, relative to the folder of test.toml")
    impact: DofText | None = Field(default=None, description="Dof that the hammer strikes")
    dofs: dict[str, DofText] = Field(
        default_factory=dict, description="Roving sensors: overrides the channels' dofs for this record"
    )
    frequency_hz: float | None = Field(default=None, gt=0, description="Sine frequency (hysteresis tests)")
    amplitude_m: float | None = Field(
        default=None, gt=0, description="Displacement amplitude (hysteresis tests)"
    )
    name: str = Field(default="", description="Name of the record; that of its file where left out")
    excitation: Excitation | None = Field(default=None, description="What drove it (continuous tests)")
    period_samples: int | None = Field(default=None, ge=2, description="Period of a periodic excitation")
    level: float | None = Field(default=None, gt=0, description="Level of the excitation, in any unit")
    first_sample: int | None = Field(default=None, ge=0, description="First sample of the part that counts")
    last_sample: int | None = Field(default=None, ge=0, description="Its last sample, counted from 0 too")
    use: Literal["fit", "held_out"] = Field(
        default="fit", description="Whether the model is fitted to it or judged by it (continuous tests)"
    )
    transient_samples: int = Field(default=0, ge=0, description="Samples at its start left out of errors")


class _TestFile(Settings):
    """The keys of ``test.toml``."""

    version: FirstLayout = Field(default=1, alias="schema", description="Version of this file's layout")
    title: str = Field(default="", description="Free text")
    kind: Literal["hammer", "hysteresis", "continuous"] = Field(default="hammer", description="Kind of test")
    serial_number: str = Field(default="", description="Which specimen was tested")
    date: DateText = Field(default="", validate_default=False, description="When it was tested, ISO 8601")
    rig: str | None = Field(default=None, description="Rig name or file; --rig wins")
    configuration: str | None = Field(default=None, description="One of the rig's configurations")
    sample_rate_hz: float | None = Field(
        default=None, gt=0, description="Required unless the record files carry it"
    )
    part: str = Field(
        default="", description="Name of this set-up (hammer, sensors) where several make up one test"
    )
    band_hz: tuple[float, float] | None = Field(
        default=None,
        description="Band in which its FRFs are used; if left out, the band of its force spectrum",
    )
    exponential_window_rad_s: float = Field(
        default=0.0,
        ge=0,
        description="Decay rate σ of the window exp(-σt) that the analyser has already applied to the records",
    )
    channels: tuple[ChannelDescription, ...] = Field(description="Channels of the record files")
    records: tuple[RecordDescription, ...] = Field(description="Record files")


class TestDescription(_TestFile):
    """One checked ``test.toml`` and the folder it lies in."""

    __test__: ClassVar[bool] = False  # not a test case, whatever pytest makes of the name

    folder: Path = Field(description="Folder that the record files are relative to")

    @property
    def file(self) -> Path:
        """The description file itself."""
        return self.folder / DESCRIPTION_FILE

    @property
    def force(self) -> ChannelDescription:
        """The force channel."""
        return next(c for c in self.channels if c.quantity == "force")

    @property
    def forces(self) -> tuple[ChannelDescription, ...]:
        """All force channels, in the order of the file; several in continuous tests only."""
        return tuple(c for c in self.channels if c.quantity == "force")

    @property
    def responses(self) -> tuple[ChannelDescription, ...]:
        """All channels but the force, in the order of the file."""
        return tuple(c for c in self.channels if c.quantity != "force")

    def dof_of(self, channel: ChannelDescription, record: RecordDescription) -> Dof | None:
        """Where `channel` sat while `record` was taken."""
        return record.dofs.get(channel.name, channel.dof)

    def path_of(self, record: RecordDescription) -> Path:
        """Path of a record file."""
        return self.folder / record.file


def read_description(folder: Path) -> TestDescription:
    """Read and check the ``test.toml`` of one folder.

    Raises
    ------
    EmaError
        Where the file is not valid TOML, has unknown, missing or contradicting keys, or names record
        files that are not there.
    """
    path = folder / DESCRIPTION_FILE
    keys = parse(_TestFile, read_toml(path), path)
    test = TestDescription.model_construct(folder=folder, **dict(keys))
    _check_texts(test)
    _check_channels(test)
    _check_part(test)
    check_records(test)
    return test


def read_channels(folder: Path) -> TestDescription:
    """Read the ``test.toml`` of a test that is being made: records may be missing, and so may their files.

    Raises
    ------
    EmaError
        Where the file is not valid TOML, or what it says of the channels is wrong.
    """
    path = folder / DESCRIPTION_FILE
    keys = parse(_TestFile, {"records": [], **read_toml(path)}, path)
    test = TestDescription.model_construct(folder=folder, **dict(keys))
    _check_texts(test)
    _check_channels(test)
    if test.kind != "hammer":
        raise EmaError(f"{path}: is of kind '{test.kind}'; only hammer tests have hits to judge")
    for channel in test.responses:
        if channel.dof is None:
            raise EmaError(f"{path}: response channel '{channel.name}' has no dof; add it")
    return test


def _check_texts(test: TestDescription) -> None:
    """Texts end up on screens and in reports, names in file names too."""
    if test.configuration is not None:
        check_name(test.configuration, f"{test.file}: configuration")
    if test.part:
        check_name(test.part, f"{test.file}: part")
    texts = {"title": test.title, "serial_number": test.serial_number, "rig": test.rig or ""}
    texts |= {f"name of channel {i + 1}": c.name for i, c in enumerate(test.channels)}
    texts |= {f"file of record {i + 1}": r.file for i, r in enumerate(test.records)}
    texts |= {f"name of record {i + 1}": r.name for i, r in enumerate(test.records)}
    for what, text in texts.items():
        if has_control_characters(text):
            raise EmaError(f"{test.file}: {what} '{text[:40]}' holds control characters; remove them")
        if len(text) > _LONGEST_TEXT:
            raise EmaError(
                f"{test.file}: {what} has {len(text)} characters, at most {_LONGEST_TEXT}; shorten it"
            )


def _check_channels(test: TestDescription) -> None:
    if not test.channels:
        raise EmaError(f"{test.file}: no channels; add a [[channels]] table for each")
    name, count = Counter(c.name for c in test.channels).most_common(1)[0]
    if count > 1:
        raise EmaError(f"{test.file}: channel '{name}' is described {count} times; keep one")
    for channel in test.channels:
        _check_channel(channel, f"{test.file}: channel '{channel.name}'")
    forces = [c.name for c in test.forces]
    if test.kind == "continuous":
        check_driven_test(test)
    elif len(forces) != 1:
        found = "none has" if not forces else f"{', '.join(forces)} have"
        raise EmaError(f'{test.file}: exactly one channel must have quantity = "force"; {found} it')
    if not test.responses:
        raise EmaError(f"{test.file}: no response channel; add a [[channels]] table for each sensor")
    if test.kind == "hysteresis" and not any(c.quantity == "displacement" for c in test.channels):
        raise EmaError(f"{test.file}: a hysteresis test needs a channel with quantity 'displacement'")


def _check_channel(channel: ChannelDescription, where: str) -> None:
    if channel.unit.strip() in ("", "?"):
        raise EmaError(
            f"{where}: unit is not filled in; write the engineering unit, e.g. "
            f"'{SI_SYMBOL[channel.quantity]}', and sensitivity_mv if the file holds volts"
        )
    try:
        unit = channel.parsed_unit
    except EmaError as error:
        raise EmaError(f"{where}: {error}") from None
    if channel.uncalibrated:
        if channel.quantity != "force":
            raise EmaError(f"{where}: only a force channel can be uncalibrated; give sensitivity_mv and unit")
        if unit.quantity != "voltage" or channel.sensitivity_mv is not None:
            raise EmaError(
                f"{where}: uncalibrated = true means volts as recorded; "
                f'write unit = "V" without sensitivity_mv, or drop uncalibrated'
            )
    elif unit.quantity == "voltage":
        remedy = f"give sensitivity_mv (mV per {SI_SYMBOL[channel.quantity]}) and the engineering unit"
        if channel.quantity == "force":
            remedy += ", or uncalibrated = true to go on with unscaled FRFs and shapes"
        raise EmaError(f"{where}: unit '{channel.unit}' is not a unit of {channel.quantity}; {remedy}")
    elif unit.quantity != channel.quantity:
        raise EmaError(
            f"{where}: quantity is '{channel.quantity}' but unit '{channel.unit}' is one of {unit.quantity}; "
            f"a unit of {channel.quantity} is e.g. '{SI_SYMBOL[channel.quantity]}'"
        )
    if channel.full_scale is not None and channel.full_scale_v is not None:
        raise EmaError(f"{where}: give full_scale or full_scale_v, not both")


def _check_part(test: TestDescription) -> None:
    if test.kind != "hammer" and (test.part or test.band_hz is not None):
        named = "part" if test.part else "band_hz"
        raise EmaError(
            f"{test.file}: {named} belongs to hammer tests, this one is of kind '{test.kind}'; remove it"
        )
    if test.band_hz is not None and not 0 <= test.band_hz[0] < test.band_hz[1]:
        low, high = test.band_hz
        raise EmaError(
            f"{test.file}: band_hz = [{low:g}, {high:g}] is no band; give its lower end first, in Hz"
        )
