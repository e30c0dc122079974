"""Rig files: a shipped rig with other numbers, or a rig of the user's own made of elements."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.rounding import lost_to_rounding, said_of_lost
from ema_pipeline.rigs.base import RigKind
from ema_pipeline.rigs.element_entries import ElementRigFile
from ema_pipeline.rigs.elements import rig_from_elements
from ema_pipeline.rigs.entries import DAMPER_UNIT, Mistake, ParameterOrNumber, check_damper, merged, parsed
from ema_pipeline.rigs.types import Parameter, Rig
from ema_pipeline.settings import Settings
from ema_pipeline.toml_lines import key_lines, line_of


class DerivedRigFile(Settings):
    """A rig file that specialises a shipped rig."""

    base: str = Field(description="name of the shipped rig")
    name: str | None = Field(
        None, min_length=1, description="name of this rig; that of its base where left out"
    )
    geometry: dict[str, int] = Field({}, description="counts, e.g. planets = 3")
    parameters: dict[str, ParameterOrNumber] = Field({}, description="values that differ from the base")
    modal_damping_scatter: float | None = Field(
        None, ge=0, le=3, description="1 sigma of ln(damping ratio) from mode to mode"
    )


def read_rig_file(path: Path, kinds: Mapping[str, RigKind]) -> Rig:
    """Read a rig file (`DerivedRigFile` where it has a ``base``, `ElementRigFile` otherwise).

    Raises
    ------
    EmaError
        Names file, line and key of whatever is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise EmaError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise EmaError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    return rig_from_text(text, path, kinds)


def rig_from_text(text: str, path: Path, kinds: Mapping[str, RigKind]) -> Rig:
    """The rig that the text of a rig file describes; `path` is named in error messages.

    Raises
    ------
    EmaError
        Names file, line and key of whatever is wrong.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise EmaError(_invalid(str(error), text, path)) from None
    try:
        return _rig(data, kinds)
    except Mistake as mistake:
        # What is missing at the top level belongs to the top.
        line = line_of(key_lines(text), mistake.location) or 1
        raise EmaError(f"{path}, line {line}: {mistake}") from None


def _invalid(message: str, text: str, path: Path) -> str:
    """What the TOML reader says, with the line that it means."""
    found = re.search(r" \(at line (\d+), column (\d+)\)$", message)
    if found is None:
        return f"{path}: is not valid TOML: {message}"
    line = text.splitlines()[int(found[1]) - 1].strip()
    shown = line if len(line) <= 60 else line[:57] + "..."
    return f"{path}, line {found[1]}: is not valid TOML: {message[: found.start()]} in '{shown}'"


def _rig(data: dict[str, Any], kinds: Mapping[str, RigKind]) -> Rig:
    if "base" in data:
        return _derived(parsed(DerivedRigFile, data), kinds)
    if "masses" in data:
        return rig_from_elements(parsed(ElementRigFile, data))
    known = {*DerivedRigFile.model_fields, *ElementRigFile.model_fields}
    for key in data:
        if key not in known:
            raise Mistake((key,), f"unknown key '{key}'{did_you_mean(key, known)}")
    raise Mistake(
        (), "key 'base' (the name of a shipped rig) or [[masses]] (a rig of elements) is missing; add it"
    )


def _derived(file: DerivedRigFile, kinds: Mapping[str, RigKind]) -> Rig:
    if file.base not in kinds:
        raise Mistake(("base",), f"base = '{file.base}' is no shipped rig{did_you_mean(file.base, kinds)}")
    kind = kinds[file.base]
    for key in file.geometry:
        if key not in kind.geometry:
            raise Mistake(
                ("geometry", key), f"unknown key 'geometry.{key}'{did_you_mean(key, kind.geometry)}"
            )
    geometry = {**kind.geometry, **file.geometry}
    try:
        kind.make(geometry, {})
    except EmaError as error:
        raise Mistake(("geometry", *list(file.geometry)[:1]), str(error)) from None
    defaults = kind.parameters(geometry)
    changed: dict[str, Parameter] = {}
    for name, entry in file.parameters.items():
        default = defaults.get(name) or kind.extra(name, geometry)
        if default is None:
            hint = did_you_mean(name, defaults)
            raise Mistake(("parameters", name), f"unknown key 'parameters.{name}'{hint}")
        changed[name] = merged(default, entry)
        if default.unit == DAMPER_UNIT:
            check_damper(changed[name])
    rig = kind.make(geometry, changed)
    _check_rounding(rig, changed, defaults)
    stated: dict[str, Any] = {"name": file.name, "modal_damping_scatter": file.modal_damping_scatter}
    stated = {key: value for key, value in stated.items() if value is not None}
    if stated and dataclasses.is_dataclass(rig) and not isinstance(rig, type):
        return dataclasses.replace(rig, **stated)
    return rig


def _check_rounding(rig: Rig, changed: Mapping[str, Parameter], defaults: Mapping[str, Parameter]) -> None:
    """Mistake where a stiffness or a mass hides the lowest modes: the number furthest from its default."""

    def decades(name: str) -> float:
        usual, given = defaults[name].value if name in defaults else 1.0, changed[name].value
        return abs(math.log10(abs(given / usual))) if given and usual else 0.0

    suspect = ("parameters", max(changed, key=decades, default=""))
    for configuration in rig.configurations:
        try:
            lost = lost_to_rounding(rig.assembly(configuration))
        except EmaError as error:
            raise Mistake(suspect, str(error)) from None
        if lost is not None:
            raise Mistake(suspect, said_of_lost(lost))
