"""Rigs of the user's own: masses, springs and dampers listed in a rig file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

from pydantic import Field, field_validator

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Row, Spring, difference
from ema_pipeline.mechanics.modes import eigen_solution
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.entries import Mistake, ParameterEntry, merged
from ema_pipeline.rigs.types import Parameter, Rig
from ema_pipeline.settings import Settings
from ema_pipeline.toml_lines import Location


def _flat(row: Any) -> Any:
    """``row = { top.x = 1.0 }`` is the same as ``row = { "top.x" = 1.0 }``."""
    if not isinstance(row, dict):
        return row
    flat: dict[str, Any] = {}
    for key, value in row.items():
        inner = {f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
        flat |= inner
    return flat


class ElementEntry(Settings):
    """A mass, spring or damper at one DOF, between two, or along a row of coefficients."""

    name: str | None = Field(None, description="name that effects and messages use")
    at: str | None = Field(None, description="DOF, to ground: 'plate.x'")
    between: tuple[str, str] | None = Field(None, description="two DOFs: ['plate.x', 'base.x']")
    row: dict[str, float] | None = Field(None, description="coefficients of the stretch over DOFs")
    value: float | str = Field(description="number in SI, or the name of a parameter")
    configurations: tuple[str, ...] = Field((), description="only in these configurations; all if empty")

    _flat_row = field_validator("row", mode="before")(_flat)

    @field_validator("between", mode="before")
    @classmethod
    def _two(cls, given: object) -> object:
        if given is not None and (not isinstance(given, list | tuple) or len(given) != 2):
            raise ValueError("name two DOFs, e.g. ['plate.x', 'base.x']")
        return given


class SensorEntry(Settings):
    """A sensor place that is no coordinate of its own."""

    dof: str = Field(description="place, 'plate.corner'")
    row: dict[str, float] = Field(description="coefficients of what the sensor reads over the coordinates")

    _flat_row = field_validator("row", mode="before")(_flat)


class ElementRigFile(Settings):
    """A rig file from scratch: its coordinates are the DOFs of its masses."""

    name: str = Field(min_length=1, description="name of the rig")
    configurations: tuple[str, ...] = Field(("default",), min_length=1, description="configurations")
    modal_damping_ratio: float = Field(
        0.01, ge=0, lt=1, description="damping ratio of every mode, 30 % tolerance"
    )
    parameters: dict[str, ParameterEntry] = Field({}, description="values with unit and tolerance")
    masses: tuple[ElementEntry, ...] = Field(min_length=1, description="masses, kg")
    springs: tuple[ElementEntry, ...] = Field((), description="springs, N/m")
    dampers: tuple[ElementEntry, ...] = Field((), description="viscous dampers, N·s/m")
    sensors: tuple[SensorEntry, ...] = Field((), description="further sensor places")

    def entries(self) -> Iterator[tuple[Location, ElementEntry]]:
        """All elements with their places in the file."""
        for section in ("masses", "springs", "dampers"):
            for i, entry in enumerate(getattr(self, section)):
                yield (section, i), entry

    def present(self, entry: ElementEntry, configuration: str) -> bool:
        """True where the element is there in this configuration."""
        return configuration in (entry.configurations or self.configurations)


def rig_from_elements(file: ElementRigFile) -> Rig:
    """The rig that a file describes.

    Raises
    ------
    Mistake
        For whatever makes no sense.
    """
    parameters: dict[str, Parameter] = {}
    for name, entry in file.parameters.items():
        if entry.value is None:
            raise Mistake(("parameters", name), f"parameter '{name}' has no value; add value = …")
        parameters[name] = merged(Parameter(name, entry.value, entry.unit or "1"), entry)
    if "modal_damping_ratio" not in parameters:
        parameters["modal_damping_ratio"] = Parameter(
            "modal_damping_ratio", file.modal_damping_ratio, "1", 0.3, 0.0, 0.5
        )
    _check_names(file)
    sensors = _sensors(file)
    for location, element in file.entries():
        _check_element(file, location, element, parameters)
        _row(element, sensors, location)
    for configuration in file.configurations:
        _check_dofs(file, configuration, sensors)
    rig = ParametricRig(
        name=file.name,
        configurations=file.configurations,
        parameters=parameters,
        build=partial(_build, file),
        uses=partial(_uses, file),
    )
    for configuration in file.configurations:
        try:
            eigen_solution(rig.system(configuration))
        except EmaError as error:
            raise Mistake(_suspect(file, parameters), str(error)) from None
    return rig


def _check_names(file: ElementRigFile) -> None:
    for name, times in Counter(file.configurations).items():
        if times > 1:
            raise Mistake(("configurations",), f"configuration '{name}' is named twice; name it once")
    known: set[str] = set()
    for location, entry in file.entries():
        if entry.name in known:
            raise Mistake((*location, "name"), f"two elements are named '{entry.name}'; name them apart")
        known |= {entry.name} if entry.name else set()


def _sensors(file: ElementRigFile) -> dict[str, Row]:
    sensors: dict[str, Row] = {}
    for i, s in enumerate(file.sensors):
        here: Location = ("sensors", i, "dof")
        place = _parsed_dof(s.dof, here)
        if place.point in sensors:
            raise Mistake(here, f"sensor place '{place.point}' is named twice; name it once")
        sensors[place.point] = {d: place.sign * c for d, c in s.row.items()}
    return sensors


def _check_element(
    file: ElementRigFile, location: Location, entry: ElementEntry, parameters: Mapping[str, Parameter]
) -> None:
    value = entry.value
    if isinstance(value, str):
        if value not in parameters:
            try:
                hint = f"; write it without quotes: value = {float(value):g}"
            except ValueError:
                hint = did_you_mean(value, parameters)
            raise Mistake((*location, "value"), f"value '{value}' is no parameter{hint}")
        value = parameters[value].value
    if location[0] == "masses" and value <= 0:
        raise Mistake((*location, "value"), f"value = {value:g} kg: give a mass above 0")
    if location[0] == "dampers" and value < 0:
        raise Mistake((*location, "value"), f"value = {value:g} N·s/m: a damper cannot be negative")
    for name in entry.configurations:
        if name not in file.configurations:
            hint = did_you_mean(name, file.configurations)
            raise Mistake((*location, "configurations"), f"unknown configuration '{name}'{hint}")


def _check_dofs(file: ElementRigFile, configuration: str, sensors: Mapping[str, Row]) -> None:
    """Every row must run over coordinates, i.e. DOFs with mass."""
    present = [(where, e) for where, e in file.entries() if file.present(e, configuration)]
    rows = {where: _row(e, sensors, where) for where, e in present}
    dofs = {d for where, row in rows.items() if where[0] == "masses" for d in row}
    for i, place in enumerate(sensors):
        rows["sensors", i] = sensors[place]
        if place in dofs:
            raise Mistake(
                ("sensors", i, "dof"),
                f"sensor place '{place}' has mass and so is a coordinate already; drop it",
            )
    where_from = f" in configuration '{configuration}'" if len(file.configurations) > 1 else ""
    for where, row in rows.items():
        for dof in row:
            if dof not in dofs:
                entry = dict(present).get(where)
                key = next((k for k in ("at", "between") if entry and getattr(entry, k)), "row")
                raise Mistake((*where, key), f"dof '{dof}' has no mass{where_from}{did_you_mean(dof, dofs)}")


def _suspect(file: ElementRigFile, parameters: Mapping[str, Parameter]) -> Location:
    """The first negative spring, or all springs."""
    for where, entry in file.entries():
        value = parameters[entry.value].value if isinstance(entry.value, str) else entry.value
        if where[0] == "springs" and value < 0:
            return (*where, "value")
    return ("springs",)


def _uses(file: ElementRigFile, configuration: str, name: str) -> bool:
    if name == "modal_damping_ratio":
        return True
    return any(entry.value == name and file.present(entry, configuration) for _, entry in file.entries())


def _build(file: ElementRigFile, configuration: str, values: Mapping[str, float]) -> Assembly:
    sensors = _sensors(file)
    kinds = {"masses": ("mass", Mass), "springs": ("spring", Spring), "dampers": ("damper", Damper)}
    elements: list[Element] = []
    numbers: Counter[str] = Counter()
    dofs: dict[str, None] = {}
    for where, e in file.entries():
        if not file.present(e, configuration):
            continue
        word, kind = kinds[str(where[0])]
        numbers[word] += 1
        row = _row(e, sensors, where)
        value = values[e.value] if isinstance(e.value, str) else e.value
        elements.append(kind(e.name or f"{word} {numbers[word]}", row, value))
        dofs |= dict.fromkeys(row) if kind is Mass else {}
    return Assembly(tuple(dofs), tuple(elements), sensors, values["modal_damping_ratio"])


def _row(entry: ElementEntry, sensors: Mapping[str, Row], location: Location) -> Row:
    """Row over coordinates; derived sensor places are replaced by theirs."""
    given = [key for key in ("at", "between", "row") if getattr(entry, key) is not None]
    if len(given) != 1:
        has = f"has {' and '.join(given)}" if given else "has none of them"
        raise Mistake(
            (*location, given[-1]) if given else location,
            f"element '{entry.name or entry.value}' needs one of at, between or row, it {has}",
        )
    if entry.row is not None:
        return dict(entry.row)

    def place(text: str) -> Row:
        dof = _parsed_dof(text, (*location, given[0]))
        return {d: dof.sign * c for d, c in sensors.get(dof.point, {dof.point: 1.0}).items()}

    if entry.at is not None:
        return place(entry.at)
    assert entry.between is not None
    row = difference(place(entry.between[0]), place(entry.between[1]))
    if not any(row.values()):
        raise Mistake(
            (*location, "between"),
            f"between '{entry.between[0]}' and itself there is no stretch; name two places",
        )
    return row


def _parsed_dof(text: str, location: Location) -> Dof:
    try:
        return Dof.parse(text)
    except EmaError as error:
        raise Mistake(location, str(error)) from None
