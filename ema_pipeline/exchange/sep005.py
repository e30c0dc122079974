"""Records as SEP-005 time series, the exchange format of the SDyPy projects, and back.

References
----------
SDyPy enhancement proposal 005, "Time series in SDyPy": one dictionary per channel with ``data``, ``name``,
``unit_str`` and ``fs`` or ``time``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.ingest.records import Record, ResponseChannel
from ema_pipeline.units import SI_SYMBOL, Unit, parse_unit

_QUANTITY = {"force": "f", "acceleration": "a", "velocity": "v", "displacement": "d"}


def to_sep005(record: Record) -> list[dict[str, Any]]:
    """Channels of a record as SEP-005 dictionaries, the hammer first.

    Beside the compulsory keys each has ``quantity``, ``group`` (the record's file) and ``dof``, so that
    `from_sep005` gives the record back.
    """
    force: dict[str, Any] = {
        "name": record.force_name,
        "data": record.force,
        "fs": record.sample_rate_hz,
        "unit_str": "N" if record.force_calibrated else "V",
        "quantity": "f",
        "group": record.file,
        "dof": str(record.impact),
    }
    responses = [
        {
            "name": channel.name,
            "data": samples,
            "fs": record.sample_rate_hz,
            "unit_str": SI_SYMBOL[channel.quantity],
            "quantity": _QUANTITY[channel.quantity],
            "group": record.file,
            "dof": str(channel.dof),
        }
        for channel, samples in zip(record.channels, np.asarray(record.responses), strict=True)
    ]
    return [force, *responses]


def from_sep005(
    channels: Sequence[Mapping[str, Any]],
    impact: str | None = None,
    dofs: Mapping[str, str] | None = None,
    file: str = "",
) -> Record:
    """Make a record of SEP-005 channels.

    Parameters
    ----------
    channels : sequence of dict
        One force channel and one or more responses, equally sampled; units are converted to SI.
    impact : str, optional
        DOF that the hammer strikes; the force channel's ``dof`` where left out.
    dofs : dict of str to str, optional
        DOF of each response by channel name; the channel's own ``dof`` where left out.
    file : str
        What messages call the record; the first channel's ``group`` where left out.

    Raises
    ------
    EmaError
        For missing keys, units that are not known, a missing or second force channel, channels of different
        rate or length, unequal sampling, or an unknown DOF.
    """
    file = file or str(next((c["group"] for c in channels if c.get("group")), "SEP-005 data"))
    read = [_read(channel, file) for channel in channels]
    forces = [k for k, (_, unit) in enumerate(read) if unit is None or unit.quantity == "force"]
    if len(forces) != 1:
        named = ", ".join(repr(str(channels[k].get("name"))) for k in forces) or "none"
        raise EmaError(
            f"{file}: one force channel is needed, found {named}; set unit_str (N) or quantity 'f'"
        )
    rates = {rate for (_, _, rate), _ in read}
    lengths = {len(samples) for (_, samples, _), _ in read}
    if max(rates) - min(rates) > 1e-6 * max(rates) or len(lengths) > 1:
        raise EmaError(f"{file}: channels differ in sample rate or length; cut and resample them first")
    responses, described = [], []
    for k, ((name, samples, _), unit) in enumerate(read):
        if unit is None or k == forces[0]:
            continue
        responses.append(samples * unit.scale)
        text = (dofs or {}).get(name) or channels[k].get("dof")
        if not text:
            raise EmaError(f"{file}: channel '{name}' has no dof; give dofs={{'{name}': 'body.direction'}}")
        described.append(ResponseChannel(name, Dof.parse(str(text)), unit.quantity))
    if not responses:
        raise EmaError(f"{file}: no response channel beside the hammer; add at least one")
    (force_name, force, rate), force_unit = read[forces[0]]
    struck = impact or channels[forces[0]].get("dof")
    if not struck:
        raise EmaError(f"{file}: the struck dof is not stated; give impact='body.direction'")
    return Record(
        file=file,
        impact=Dof.parse(str(struck)),
        sample_rate_hz=rate,
        force_name=force_name,
        force=force * (force_unit.scale if force_unit else 1.0),
        responses=np.stack(responses),
        channels=tuple(described),
        force_calibrated=force_unit is not None,
    )


def _read(channel: Mapping[str, Any], file: str) -> tuple[tuple[str, Any, float], Unit | None]:
    """(name, samples, rate) and unit of one channel; no unit for a hammer that is in volts."""
    for key in ("name", "data", "unit_str"):
        if key not in channel:
            raise EmaError(f"{file}: channel '{channel.get('name', '?')}' has no '{key}'; SEP-005 needs it")
    name = str(channel["name"])
    samples = np.asarray(channel["data"], dtype=np.float64)
    if samples.ndim != 1 or samples.size < 2 or not np.all(np.isfinite(samples)):
        raise EmaError(f"{file}: channel '{name}' is not a row of at least two finite samples; repair it")
    try:
        unit = parse_unit(str(channel["unit_str"]))
    except EmaError as error:
        raise EmaError(f"{file}: channel '{name}': {error}; correct unit_str") from None
    if unit.quantity == "voltage":
        if channel.get("quantity") == "f":
            return (name, samples * unit.scale, _rate(channel, name, file)), None
        raise EmaError(
            f"{file}: channel '{name}' is in {unit.symbol}; convert it to its quantity's unit first"
        )
    if unit.quantity not in _QUANTITY:
        raise EmaError(
            f"{file}: channel '{name}' is in {unit.symbol}, neither force nor motion; leave it out"
        )
    return (name, samples, _rate(channel, name, file)), unit


def _rate(channel: Mapping[str, Any], name: str, file: str) -> float:
    if channel.get("fs") is not None:
        return float(channel["fs"])
    if channel.get("time") is None:
        raise EmaError(f"{file}: channel '{name}' has neither 'fs' nor 'time'; SEP-005 needs one")
    time = np.asarray(channel["time"], dtype=np.float64)
    steps = np.diff(time)
    step = float(np.mean(steps)) if steps.size else 0.0
    if step <= 0 or np.max(np.abs(steps - step)) > 1e-3 * step:
        raise EmaError(f"{file}: channel '{name}' is not equally sampled; resample it first")
    return 1.0 / step
