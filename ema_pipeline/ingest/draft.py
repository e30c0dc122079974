"""Drafts a test.toml from the record files: what they tell is filled in, what they do not is marked."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.files import refuse_existing, replace_file
from ema_pipeline.ingest.derived import derived_channels
from ema_pipeline.ingest.description import DESCRIPTION_FILE, RIG_FILE
from ema_pipeline.ingest.file_size_limits import ReadLimits
from ema_pipeline.ingest.load import COARSEST_RATE
from ema_pipeline.ingest.readers import read_raw, reader_of
from ema_pipeline.ingest.readers.raw import FULL_SCALE, RawChannel, RawRecord
from ema_pipeline.ingest.swap import is_pulse
from ema_pipeline.plain_text import printable
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.units import SI_SYMBOL, Unit, find_unit

_HAMMER_NAME = re.compile(r"hammer|hmr|impact|impuls|force|kraft|(^|[^a-z])ham([^a-z]|$)", re.IGNORECASE)
_DIRECTIONS = ("x", "y", "z", "u", "zeta", "eta", "rx", "ry", "rz")
_REPEATED = {
    "set",
    "take",
    "rep",
    "repeat",
    "repetition",
    "trial",
    "hit",
    "hits",
    "blow",
    "meas",
    "measurement",
}
_PLACEHOLDER_DIRECTION = "z"
_REMEDY = "rename it to draft anew"
_ENGINEERING = ("force", "acceleration", "velocity", "displacement")


@dataclass(frozen=True)
class _Found:
    """A record file that could be read."""

    file: str
    raw: RawRecord


def write_drafts(raw: Path, limits: ReadLimits | None = None) -> list[Path]:
    """Write a drafted ``test.toml`` into `raw`, or into each of its sub-folders that holds record files.

    Parameters
    ----------
    raw : Path
    limits : ReadLimits, optional
        How large a record file may be.

    Returns
    -------
    list of Path
        The files written; sub-folders that have a description already are left alone.

    Raises
    ------
    EmaError
        Where there is no record file, or where every folder has its description already.
    """
    if not raw.exists():
        raise EmaError(f"{raw}: there is no such folder; give the folder that holds the record files")
    if not raw.is_dir():
        raise EmaError(f"{raw}: is a file, not a folder; give the folder that holds the record files")
    if (raw / DESCRIPTION_FILE).exists() or _candidates(raw):
        folders = [raw]
    else:
        below = sorted(p for p in raw.iterdir() if p.is_dir() and not p.name.startswith("."))
        folders = [p for p in below if _candidates(p)]
    if not folders:
        raise EmaError(f"{raw}: no record files here or in its sub-folders; copy them here first")
    missing = [folder for folder in folders if not (folder / DESCRIPTION_FILE).exists()]
    if not missing:
        refuse_existing([folders[0] / DESCRIPTION_FILE], _REMEDY)
    drafts = {folder / DESCRIPTION_FILE: draft_description(folder, limits) for folder in missing}
    for path, text in drafts.items():
        replace_file(path, text)
    return list(drafts)


def draft_description(raw: Path, limits: ReadLimits | None = None) -> str:
    """Draft the text of ``test.toml`` for the record files that lie in folder `raw`.

    Channels, units and sample rate come from the files; the hammer is known by its name, its unit or its
    pulses. What the files do not tell is marked ``# CHECK:``, and is written so that loading the records
    stops with a clear message where a guess would scale data wrongly.

    Raises
    ------
    EmaError
        Where `raw` has a description already, or no record file that can be read.
    """
    refuse_existing([raw / DESCRIPTION_FILE], _REMEDY)
    found, problems = _read_all(raw, limits)
    if not found:
        reason = f"; {problems[0]}" if problems else ""
        raise EmaError(f"{raw}: no record file that can be read{reason}")
    channels = _common_channels(found)
    left_out = derived_channels(channels)
    hammer = _find_hammer(_without(channels, left_out), found)
    left_out = derived_channels(channels, hammer)
    channels = _without(channels, left_out)
    lines = [
        "# Drafted by 'ema init'. Go through every line marked CHECK, then run 'ema check' on this folder.",
        *(f"# CHECK: not drafted: {problem}" for problem in problems),
        "schema = 1",
        f"title = {_quoted(raw.resolve().name)}",
        '# rig = "planetary"            # CHECK: name of the rig, or leave it to --rig or a rig.toml',
        '# configuration = "no_ring"    # CHECK: one of the rig\'s configurations',
        *_rate_lines(found),
        *(f"# left out: {_quoted(name)} is {what}" for name, what in left_out.items()),
    ]
    dofs = _channel_dofs(channels, hammer)
    calibrated = any(_unit_of(c) in _ENGINEERING for n, c in channels.items() if n != hammer)
    for name, channel in channels.items():
        lines += ["", "[[channels]]", f"name = {_quoted(name)}"]
        if name == hammer:
            lines += _hammer_lines(channel, responses_calibrated=calibrated)
        else:
            lines += _response_lines(channel, dofs[name])
        lines += _presence_comment(name, found)
    nodes = {Dof.parse(c.dof).body: dofs[n][0].body for n, c in channels.items() if n in dofs and c.dof}
    lines += ["", *_record_lines(found, [dof for dof, _ in dofs.values()], hammer, nodes)]
    return "\n".join(lines) + "\n"


def _candidates(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return [
        p
        for p in files
        if p.name not in (DESCRIPTION_FILE, RIG_FILE, RESULTS_FILE)
        and p.stat().st_size > 0
        and reader_of(p) is not None
    ]


def _read_all(folder: Path, limits: ReadLimits | None) -> tuple[list[_Found], list[str]]:
    found, problems = [], []
    for path in _candidates(folder):
        try:
            found.append(_Found(path.name, read_raw(path, limits)))
        except EmaError as error:
            problems.append(str(error))
    return found, problems


def _common_channels(found: list[_Found]) -> dict[str, RawChannel]:
    """Channels of the file that stands for most others, of the length that most of them have."""
    usual = Counter(tuple(f.raw.channels) for f in found).most_common(1)[0][0]
    channels = next(f.raw.channels for f in found if tuple(f.raw.channels) == usual)
    length = Counter(c.samples.size for c in channels.values()).most_common(1)[0][0]
    return {name: c for name, c in channels.items() if c.samples.size == length}


def _without(channels: Mapping[str, RawChannel], names: Mapping[str, str]) -> dict[str, RawChannel]:
    return {name: channel for name, channel in channels.items() if name not in names}


def _find_hammer(channels: Mapping[str, RawChannel], found: list[_Found]) -> str | None:
    """The hammer by its name, by a unit of force, by being the only one in volts, or by its pulses."""
    named = [n for n in channels if _HAMMER_NAME.search(n)]
    in_force = [n for n, c in channels.items() if _unit_of(c) == "force"]
    in_volts = [n for n, c in channels.items() if _unit_of(c) == "voltage"]
    scaled = [n for n, c in channels.items() if _unit_of(c) in _ENGINEERING]
    for choice in (named, in_force, in_volts if len(scaled) == len(channels) - 1 else []):
        if len(choice) == 1:
            return choice[0]
    pulses: Counter[str] = Counter()
    for record in found:
        pulses.update(
            n for n in channels if n in record.raw.channels and is_pulse(record.raw.channels[n].samples)
        )
    ranked = [n for n, count in pulses.most_common() if count * 2 > len(found)]
    preferred = [n for n in ranked if n in named or n in in_force]
    if preferred or len(ranked) == 1:
        return (preferred or ranked)[0]
    return next(iter([*named, *in_force]), None)


def _unit_of(channel: RawChannel) -> str | None:
    unit = _known_unit(channel)
    return unit.quantity if unit is not None else None


def _known_unit(channel: RawChannel) -> Unit | None:
    return find_unit(channel.unit) if channel.unit is not None else None


def _rate_lines(found: list[_Found]) -> list[str]:
    told = [f.raw for f in found if f.raw.rate_tolerance <= COARSEST_RATE]
    rates = sorted({raw.sample_rate_hz for raw in told if raw.sample_rate_hz is not None})
    if not rates:
        return ["# sample_rate_hz =    # CHECK: the files do not tell it; fill it in and remove the '#'"]
    if rates[-1] / rates[0] - 1 > 1e-4:
        return [
            f"# CHECK: the files differ in sample rate ({rates[0]:.10g} to {rates[-1]:.10g} Hz); split them"
        ]
    return [f"sample_rate_hz = {rates[0]:.10g}    # from the files"]


def _hammer_lines(channel: RawChannel, responses_calibrated: bool) -> list[str]:
    unit = _known_unit(channel)
    lines = ['quantity = "force"']
    if unit is not None and unit.quantity == "force":
        return [*lines, f'unit = "{unit.symbol}"']
    if unit is not None and unit.quantity == "voltage":
        if responses_calibrated:
            return [
                *lines,
                'unit = "V"',
                "uncalibrated = true",
                "# CHECK: the hammer is in volts, its sensitivity is unknown: FRFs and shapes will be",
                '# unscaled (frequencies and damping are not affected). For scaled ones write unit = "N" and',
                "# sensitivity_mv = mV per N, from the hammer's data sheet, in place of the two lines above.",
            ]
        return [
            *lines,
            'unit = "N"',
            "# sensitivity_mv = 2.25    # CHECK: mV per N, from the hammer's data sheet",
        ]
    return [*lines, *_unknown_unit(channel, "N")]


def _response_lines(channel: RawChannel, dof: tuple[Dof, bool]) -> list[str]:
    unit = _known_unit(channel)
    if unit is not None and unit.quantity in _ENGINEERING:
        lines = [f'quantity = "{unit.quantity}"', f'unit = "{unit.symbol}"']
    elif unit is not None and unit.quantity == "voltage":
        lines = [
            'quantity = "acceleration"    # CHECK',
            f'unit = "{SI_SYMBOL["acceleration"]}"',
            "# sensitivity_mv = 10.2    # CHECK: mV per m/s^2, from the sensor's data sheet",
        ]
    else:
        lines = ['quantity = "acceleration"    # CHECK', *_unknown_unit(channel, SI_SYMBOL["acceleration"])]
    where, known = dof
    remark = "" if known else "    # CHECK: where it sits and which way it points; '-' in front for reversed"
    return [*lines, f'dof = "{where}"{remark}']


def _unknown_unit(channel: RawChannel, example: str) -> list[str]:
    if channel.unit == FULL_SCALE:
        return [
            f'unit = "?"    # CHECK: engineering unit, e.g. "{example}"',
            f"# sensitivity_mv = 1.0    # CHECK: mV per {example}, from the data sheet",
            "# full_scale_v = 10.0    # CHECK: volts at full scale; the file holds fractions of it",
        ]
    said = f" (the file says {_quoted(channel.unit)})" if channel.unit is not None else ""
    return [
        f'unit = "?"    # CHECK: the file does not say{said}; e.g. "{example}"',
        f"# sensitivity_mv = 1.0    # CHECK: mV per {example}; only if the file holds volts",
    ]


def _channel_dofs(channels: Mapping[str, RawChannel], hammer: str | None) -> dict[str, tuple[Dof, bool]]:
    """Where each response sits, and whether its name says so (``sun_x``, ``planet1.eta``)."""
    responses = [n for n in channels if n != hammer]
    hints = [channels[n].dof for n in responses]
    use_hints = None not in hints and len(set(hints)) == len(hints)
    result: dict[str, tuple[Dof, bool]] = {}
    taken: set[str] = set()
    for name in responses:
        named = re.fullmatch(rf"([A-Za-z][\w-]*?|\d+)[_. -]({'|'.join(_DIRECTIONS)})", name, re.IGNORECASE)
        hint = channels[name].dof
        if named:
            dof, known = Dof(named[1], named[2].lower()), True
        elif use_hints and hint is not None:
            dof, known = Dof.parse(hint), False
        else:
            dof, known = Dof(_body(name), _PLACEHOLDER_DIRECTION), False
        while dof.point in taken:
            dof, known = Dof(f"{dof.body}_b", dof.direction), False
        taken.add(dof.point)
        result[name] = (dof, known)
    return result


def _body(name: str) -> str:
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    return plain if re.match(r"[A-Za-z0-9]", plain) else "point"


def _presence_comment(name: str, found: list[_Found]) -> list[str]:
    lacking = [f.file for f in found if name not in f.raw.channels]
    return (
        [f"# CHECK: not in {', '.join(map(_quoted, lacking[:3]))}{' and others' if len(lacking) > 3 else ''}"]
        if lacking
        else []
    )


def _record_lines(
    found: list[_Found], dofs: list[Dof], hammer: str | None, nodes: Mapping[str, str]
) -> list[str]:
    bodies = {dof.body.casefold(): dof.body for dof in dofs}
    impacts: list[tuple[str, bool]] = []
    placeholders: dict[str, str] = {}
    for record in found:
        stem = record.file.split(".", 1)[0]
        known = _impact_in(stem, bodies) or _impact_stated(record.raw, hammer, nodes)
        key = _blow_key(stem)
        if known is None and key not in placeholders:
            placeholders[key] = f"hit{len(placeholders) + 1}.{_PLACEHOLDER_DIRECTION}"
        impacts.append((known or placeholders[key], known is not None))
    lines: list[str] = []
    if placeholders:
        lines += [
            "# CHECK: impact is the dof that the hammer struck. Records with the same impact are averaged:",
            "# give the same one only to repeated blows on one point of the same, unchanged structure.",
        ]
    if len(placeholders) == 1 and len(found) > 1:
        lines += ["# By their names these files repeat one measurement; if they do not, correct impact."]
    for record, (impact, is_known) in zip(found, impacts, strict=True):
        remark = "" if is_known else "    # CHECK"
        lines += ["[[records]]", f"file = {_quoted(record.file)}", f'impact = "{impact}"{remark}', ""]
    return lines[:-1]


def _impact_in(stem: str, bodies: Mapping[str, str]) -> str | None:
    """``sun_y_1`` names ``sun.y`` where a sensor sits on the sun."""
    tokens = re.split(r"[^A-Za-z0-9]+", stem)
    for i, (body, direction) in enumerate(pairwise(tokens)):
        if direction.lower() in _DIRECTIONS:
            for start in range(i + 1):
                joined = "_".join([*tokens[start:i], body]).casefold()
                if joined in bodies:
                    return f"{bodies[joined]}.{direction.lower()}"
    return None


def _impact_stated(raw: RawRecord, hammer: str | None, nodes: Mapping[str, str]) -> str | None:
    """The struck node and direction where the file states them: the reference of its responses, or the hammer's place.

    A node that bears a sensor is called as that sensor's channel calls it.
    """
    references = {c.reference for n, c in raw.channels.items() if n != hammer and c.reference}
    stated = references or {c.dof for n, c in raw.channels.items() if n == hammer and c.dof}
    if len(stated) != 1:
        return None
    dof = Dof.parse(stated.pop())
    return str(Dof(nodes.get(dof.body, dof.body), dof.direction, dof.sign))


def impact_of(stem: str, raw: RawRecord, dofs: Sequence[Dof], hammer: str) -> Dof | None:
    """The DOF that was struck, as the file's name or the file itself tells it; None where neither does.

    Parameters
    ----------
    stem : str
        Name of the file without its ending.
    raw : RawRecord
    dofs : sequence of Dof
        Where sensors sit.
    hammer : str
        Name of the hammer's channel.
    """
    found = _impact_in(stem, {d.body.casefold(): d.body for d in dofs}) or _impact_stated(raw, hammer, {})
    return None if found is None else Dof.parse(found)


def _blow_key(stem: str) -> str:
    """What repetitions of one blow have in common: ``imp_set1_nomass`` and ``imp_set2_no_mass`` are alike.

    Only a number behind a word such as *set* or *hit* counts repetitions; ``point07`` and ``run07`` may as
    well be another place, and averaging two places would spoil both.
    """
    words = "|".join(sorted(_REPEATED, key=len, reverse=True))
    counted = re.sub(rf"(?<![A-Za-z])({words})[ _-]?\d+(?!\d)", r"\1", stem, flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]", "", counted.casefold())


def _quoted(text: str) -> str:
    """A TOML basic string; JSON escapes the same characters in the same way."""
    return json.dumps(printable(text), ensure_ascii=False)
