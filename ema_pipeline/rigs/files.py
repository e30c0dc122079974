"""Rig files: a shipped rig with other numbers, or a rig of the user's own made of elements."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from pydantic import Field, field_validator

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Row, Spring, difference
from ema_pipeline.rigs.base import ParametricRig, RigKind
from ema_pipeline.rigs.types import Parameter, Rig
from ema_pipeline.settings import Settings, parse


class ParameterEntry(Settings):
    """One parameter of a rig file; what is left out keeps its default."""

    value: float | None = Field(None, description="nominal value in `unit`")
    unit: str | None = Field(None, description="unit, checked against the one that the rig works in")
    tolerance: float | None = Field(
        None, ge=0, description="relative standard deviation of the nominal value"
    )
    min: float | None = Field(None, description="lower bound")
    max: float | None = Field(None, description="upper bound")
    free: bool | None = Field(None, description="true where the data alone must determine the parameter")


class DerivedRigFile(Settings):
    """A rig file that specialises a shipped rig."""

    base: str = Field(description="name of the shipped rig")
    name: str | None = Field(None, description="name of this rig; that of its base where left out")
    geometry: dict[str, int] = Field({}, description="counts, e.g. planets = 3")
    parameters: dict[str, ParameterEntry] = Field({}, description="values that differ from the base")

    @field_validator("parameters", mode="before")
    @classmethod
    def _number_is_a_value(cls, given: object) -> object:
        """``sun_mass = 2.0`` is short for ``sun_mass = { value = 2.0 }``."""
        if not isinstance(given, dict):
            return given
        return {k: v if isinstance(v, dict) else {"value": v} for k, v in given.items()}


class ElementEntry(Settings):
    """A mass, spring or damper at one DOF, between two, or along a row of coefficients."""

    name: str | None = Field(None, description="name that effects and messages use")
    at: str | None = Field(None, description="DOF, to ground: 'plate.x'")
    between: tuple[str, str] | None = Field(None, description="two DOFs: ['plate.x', 'base.x']")
    row: dict[str, float] | None = Field(None, description="coefficients of the stretch over DOFs")
    value: float | str = Field(description="number in SI, or the name of a parameter")
    configurations: tuple[str, ...] = Field((), description="only in these configurations; all if empty")


class SensorEntry(Settings):
    """A sensor place that is no coordinate of its own."""

    dof: str = Field(description="place, 'plate.corner'")
    row: dict[str, float] = Field(description="coefficients of what the sensor reads over the coordinates")


class ElementRigFile(Settings):
    """A rig file from scratch: its coordinates are the DOFs of its masses."""

    name: str = Field(description="name of the rig")
    configurations: tuple[str, ...] = Field(("default",), min_length=1, description="configurations")
    modal_damping_ratio: float = Field(
        0.01, ge=0, lt=1, description="damping ratio of every mode, 30 % tolerance"
    )
    parameters: dict[str, ParameterEntry] = Field({}, description="values with unit and tolerance")
    masses: tuple[ElementEntry, ...] = Field(min_length=1, description="masses, kg")
    springs: tuple[ElementEntry, ...] = Field((), description="springs, N/m")
    dampers: tuple[ElementEntry, ...] = Field((), description="viscous dampers, N·s/m")
    sensors: tuple[SensorEntry, ...] = Field((), description="further sensor places")


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
        raise EmaError(f"{path}: is not valid TOML: {error}") from None
    try:
        if "base" in data or "masses" not in data:
            return _derived(parse(DerivedRigFile, data, path), kinds, path)
        return _from_elements(parse(ElementRigFile, data, path), path)
    except EmaError as error:
        raise EmaError(_with_line(str(error), path, text)) from None


def _with_line(message: str, path: Path, text: str) -> str:
    """Put the line of the key that the message quotes last-but-hint after the file's name."""
    quoted = re.search(r"'([^']+)'", message.removeprefix(str(path)))
    if quoted is None:
        quoted = re.search(r": ([\w.]+) = ", message.removeprefix(str(path)))
    if quoted is None:
        return message
    for part in reversed(re.split(r"\.(?=[A-Za-z_])", quoted[1])):
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(rf"(?<![\w-]){re.escape(part)}(?![\w-])", line.split("#")[0]):
                return message.replace(str(path), f"{path}, line {number}", 1)
    return message


def _derived(file: DerivedRigFile, kinds: Mapping[str, RigKind], path: Path) -> Rig:
    if file.base not in kinds:
        raise EmaError(f"{path}: base = '{file.base}' is no shipped rig{did_you_mean(file.base, kinds)}")
    kind = kinds[file.base]
    for key in file.geometry:
        if key not in kind.geometry:
            raise EmaError(f"{path}: unknown key 'geometry.{key}'{did_you_mean(key, kind.geometry)}")
    geometry = {**kind.geometry, **file.geometry}
    try:
        kind.make(geometry, {})
    except EmaError as error:
        raise EmaError(f"{path}: {error}") from None
    defaults = kind.parameters(geometry)
    changed: dict[str, Parameter] = {}
    for name, entry in file.parameters.items():
        default = defaults.get(name) or kind.extra(name, geometry)
        if default is None:
            raise EmaError(f"{path}: unknown key 'parameters.{name}'{did_you_mean(name, defaults)}")
        changed[name] = _merge(default, entry, path)
    rig = kind.make(geometry, changed)
    if file.name and dataclasses.is_dataclass(rig) and not isinstance(rig, type):
        return dataclasses.replace(rig, name=file.name)
    return rig


def _merge(default: Parameter, given: ParameterEntry, path: Path) -> Parameter:
    """The default parameter with what the file says instead; a stated tolerance makes it a known one."""
    name = default.name
    if given.unit is not None and _plain_unit(given.unit) != _plain_unit(default.unit):
        raise EmaError(
            f"{path}: parameter '{name}' has unit '{given.unit}', the rig works in '{default.unit}'; "
            f"convert the value to {default.unit}"
        )
    free = given.free if given.free is not None else default.free and given.tolerance is None
    merged = Parameter(
        name=name,
        value=default.value if given.value is None else given.value,
        unit=default.unit,
        tolerance=default.tolerance if given.tolerance is None else given.tolerance,
        minimum=default.minimum if given.min is None else given.min,
        maximum=default.maximum if given.max is None else given.max,
        free=free,
    )
    if not merged.minimum <= merged.value <= merged.maximum:
        raise EmaError(
            f"{path}: parameter '{name}' = {merged.value:g} {merged.unit} lies outside its bounds "
            f"{merged.minimum:g} … {merged.maximum:g}; change value, min or max"
        )
    return merged


def _plain_unit(unit: str) -> str:
    """Units as people type them: N·s/m = N*s/m = Ns/m, deg = °, 1 = '' = '-'."""
    plain = re.sub(r"[\s·*.]", "", unit)
    return {"°": "deg", "degree": "deg", "degrees": "deg", "": "1", "-": "1"}.get(plain, plain)


def _from_elements(file: ElementRigFile, path: Path) -> Rig:
    parameters: dict[str, Parameter] = {}
    for name, entry in file.parameters.items():
        if entry.value is None:
            raise EmaError(f"{path}: parameter '{name}' has no value; add value = …")
        parameters[name] = _merge(Parameter(name, entry.value, entry.unit or "1"), entry, path)
    if "modal_damping_ratio" not in parameters:
        parameters["modal_damping_ratio"] = Parameter(
            "modal_damping_ratio", file.modal_damping_ratio, "1", 0.3, 0.0, 0.5
        )
    rig = ParametricRig(
        name=file.name,
        configurations=file.configurations,
        parameters=parameters,
        build=partial(_build, file),
        uses=partial(_uses, file),
    )
    for element in (*file.masses, *file.springs, *file.dampers):
        value = element.value
        if isinstance(value, str) and value not in parameters:
            raise EmaError(f"{path}: value '{value}' is no parameter{did_you_mean(value, parameters)}")
        for name in element.configurations:
            if name not in file.configurations:
                hint = did_you_mean(name, file.configurations)
                raise EmaError(f"{path}: unknown configuration '{name}'{hint}")
    try:
        for configuration in file.configurations:
            rig.system(configuration)
    except EmaError as error:
        raise EmaError(f"{path}: {error}") from None
    return rig


def _uses(file: ElementRigFile, configuration: str, name: str) -> bool:
    if name == "modal_damping_ratio":
        return True
    return any(
        entry.value == name and configuration in (entry.configurations or file.configurations)
        for entry in (*file.masses, *file.springs, *file.dampers)
    )


def _build(file: ElementRigFile, configuration: str, values: Mapping[str, float]) -> Assembly:
    def present(entries: tuple[ElementEntry, ...]) -> list[ElementEntry]:
        return [e for e in entries if configuration in (e.configurations or file.configurations)]

    def number(entry: ElementEntry) -> float:
        return values[entry.value] if isinstance(entry.value, str) else entry.value

    masses = present(file.masses)
    sensors = {s.dof: s.row for s in file.sensors}
    dofs = tuple(dict.fromkeys(d for e in masses for d in _row(e, sensors)))
    elements: list[Element] = []
    for i, e in enumerate(masses, 1):
        elements.append(Mass(e.name or f"mass {i}", _row(e, sensors), number(e)))
    for i, e in enumerate(present(file.springs), 1):
        elements.append(Spring(e.name or f"spring {i}", _row(e, sensors), number(e)))
    for i, e in enumerate(present(file.dampers), 1):
        elements.append(Damper(e.name or f"damper {i}", _row(e, sensors), number(e)))
    return Assembly(dofs, tuple(elements), sensors, values["modal_damping_ratio"])


def _row(entry: ElementEntry, sensors: Mapping[str, Row]) -> Row:
    """Row over coordinates; derived sensor places are replaced by theirs."""
    if sum(x is not None for x in (entry.at, entry.between, entry.row)) != 1:
        raise EmaError(f"element '{entry.name or entry.value}' needs one of at, between or row")
    if entry.row is not None:
        return dict(entry.row)

    def place(text: str) -> Row:
        dof = Dof.parse(text)
        return {d: dof.sign * c for d, c in sensors.get(dof.point, {dof.point: 1.0}).items()}

    if entry.at is not None:
        return place(entry.at)
    assert entry.between is not None
    return difference(place(entry.between[0]), place(entry.between[1]))
