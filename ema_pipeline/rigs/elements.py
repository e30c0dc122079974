"""Rigs of the user's own: masses, springs, dampers and nonlinear elements listed in a rig file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import (
    Assembly,
    Damper,
    Element,
    Gyroscopic,
    Mass,
    Nonlinear,
    Row,
    Spring,
    difference,
)
from ema_pipeline.mechanics.laws import (
    BoucWen,
    DryFriction,
    Maxwell,
    PartingSpring,
    PolynomialSpring,
    check_element,
)
from ema_pipeline.mechanics.rounding import lost_to_rounding, said_of_lost
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.element_entries import ElementEntry, ElementRigFile, NonlinearEntry
from ema_pipeline.rigs.entries import LARGEST_LOSS_FACTOR, Mistake, check_damper, merged
from ema_pipeline.rigs.types import Parameter, Rig
from ema_pipeline.rigs.units import UNITS_OF, factor_to
from ema_pipeline.toml_lines import Location


def rig_from_elements(file: ElementRigFile) -> Rig:
    """The rig that a file describes.

    Raises
    ------
    Mistake
        For whatever makes no sense.
    """
    file, parameters = _in_si(file), {}
    for name, entry in file.parameters.items():
        if not name.strip():
            raise Mistake(("parameters", name), f"parameter '{name}' has no name; give it one")
        if entry.value is None:
            raise Mistake(("parameters", name), f"parameter '{name}' has no value; add value = …")
        unit = _unit_of(file, name, entry.unit)
        parameters[name] = merged(Parameter(name, entry.value, unit), entry)
    if "modal_damping_ratio" in parameters and "modal_damping_ratio" in file.model_fields_set:
        said = f"modal_damping_ratio = {file.modal_damping_ratio:g} is given at the top as well; keep one of the two"
        raise Mistake(("parameters", "modal_damping_ratio"), said)
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
        build=partial(_build, file, _names(file)),
        uses=partial(_uses, file),
        modal_damping_scatter=file.modal_damping_scatter,
    )
    for configuration in file.configurations:
        try:
            assembly = rig.assembly(configuration)
            lost = lost_to_rounding(assembly)
        except EmaError as error:
            raise Mistake(_suspect(file, parameters, str(error)), str(error)) from None
        if lost is not None:
            there = [x for x in file.entries() if file.present(x[1], configuration)]
            where, element = there[assembly.elements.index(lost)]
            number = element.value
            raise Mistake(
                ("parameters", number) if isinstance(number, str) else (*where, "value"), said_of_lost(lost)
            )
    return rig


def _in_si(file: ElementRigFile) -> ElementRigFile:
    """The file with the numbers of elements that state a unit in SI."""
    sections: dict[str, list[ElementEntry]] = {}
    for (section, *index), entry in file.entries():
        if entry.unit is not None:
            if isinstance(entry.value, str):
                said = f"value is the parameter '{entry.value}', whose own unit counts; drop unit"
                raise Mistake((section, *index, "unit"), said)
            units = _units_of(str(section), "value", entry)
            factor = next((f for u in units if (f := factor_to(entry.unit, u))), None)
            if factor is None:
                said = f"unit '{entry.unit}' is not one of {' or '.join(units)} or their multiples"
                raise Mistake((section, *index, "unit"), said)
            entry = entry.model_copy(update={"value": factor * entry.value, "unit": None})
        sections.setdefault(str(section), []).append(entry)
    return file.model_copy(update={name: tuple(entries) for name, entries in sections.items()})


def _unit_of(file: ElementRigFile, name: str, given: str | None) -> str:
    """The SI unit of a parameter, from the elements that use it; as stated where none does.

    Raises
    ------
    Mistake
        Where the stated unit has another dimension than what an element takes.
    """
    uses = [
        (str(where[0]), units)
        for where, entry in file.entries()
        for key, number in entry.numbers.items()
        if number == name and (units := _units_of(str(where[0]), key, entry))
    ]
    if given is None or not uses:
        return given or "1"
    kept = uses[0][1]
    for section, units in uses:
        kept = tuple(u for u in kept if u in units and factor_to(given, u))
        if not kept:
            said = f"parameter '{name}' has unit '{given}', but [[{section}]] takes {' or '.join(units)}"
            raise Mistake(("parameters", name, "unit"), f"{said}, or multiples of these")
    return given if factor_to(given, kept[0]) == 1.0 else kept[0]


def _units_of(section: str, key: str, entry: ElementEntry) -> tuple[str, ...]:
    """SI units of one number of an element; none for a number without a dimension."""
    law = entry.law if isinstance(entry, NonlinearEntry) else section
    units = UNITS_OF.get(law if key == "value" else key, ())
    dofs = [d for d in (entry.at, *(entry.between or ()), *(entry.row or ())) if d]
    return units[:1] if all(d.rpartition(".")[2] in ALONG for d in dofs) else units


ALONG = ("x", "y", "z")
"""Directions that are no angles; any other may be one."""


def _check_names(file: ElementRigFile) -> None:
    for name, times in Counter(file.configurations).items():
        if times > 1:
            raise Mistake(("configurations",), f"configuration '{name}' is named twice; name it once")
    for i, mass in enumerate(file.masses):
        if not mass.name and mass in file.masses[:i]:
            raise Mistake(("masses", i), "the same mass is listed twice; take one out, or give both a name")
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
    for key, number in entry.numbers.items():
        if isinstance(number, str) and number not in parameters:
            try:
                hint = f"; write it without quotes: {key} = {float(number):g}"
            except ValueError:
                hint = did_you_mean(number, parameters)
            raise Mistake((*location, key), f"{key} '{number}' is no parameter{hint}")
    if entry.lacks is not None:
        raise Mistake(location, f"key '{entry.lacks}' is missing; add it")
    values = {k: parameters[x].value if isinstance(x, str) else x for k, x in entry.numbers.items()}
    value = values["value"]
    if location[0] == "masses" and value <= 0:
        raise Mistake((*location, "value"), f"value = {value:g} kg: give a mass above 0")
    if location[0] == "dampers" and value < 0:
        raise Mistake((*location, "value"), f"value = {value:g} N·s/m: a damper cannot be negative")
    if location[0] == "dampers" and isinstance(entry.value, str):
        check_damper(parameters[entry.value])
    if isinstance(entry, NonlinearEntry) and entry.law == "friction" and value < 0:
        raise Mistake(
            (*location, "value"), f"value = {value:g} N: friction cannot be negative; give 0 or more"
        )
    if isinstance(entry, NonlinearEntry) and entry.law == "relaxation" and value < 0:
        # Its damper, stiffness times time, would be negative and feed energy in.
        said = f"value = {value:g} N/m: a relaxation cannot be negative; give 0 or more"
        raise Mistake((*location, "value"), said)
    if (loss := values.get("loss_factor", 0.0)) < 0:
        said = f"loss_factor = {loss:g}: a loss factor cannot be negative; give 0 or more"
        raise Mistake((*location, "loss_factor"), said)
    if loss > LARGEST_LOSS_FACTOR:
        said = f"loss_factor = {loss:g}: no material has one above {LARGEST_LOSS_FACTOR:g}; 15 % is 0.15"
        raise Mistake((*location, "loss_factor"), said)
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


def _suspect(file: ElementRigFile, parameters: Mapping[str, Parameter], message: str) -> Location:
    """The element that the message names, or the first negative spring, or all springs."""
    for where, entry in file.entries():
        if where[0] == "nonlinear" and f"'{entry.name or f'nonlinear {int(where[1]) + 1}'}'" in message:
            return where
        value = parameters[entry.value].value if isinstance(entry.value, str) else entry.value
        if where[0] == "springs" and value < 0:
            return (*where, "value")
    return ("springs",)


def _uses(file: ElementRigFile, configuration: str, name: str) -> bool:
    if name == "modal_damping_ratio":
        return True
    return any(
        name in entry.numbers.values() and file.present(entry, configuration) for _, entry in file.entries()
    )


_WORDS = {"masses": "mass", "springs": "spring", "dampers": "damper"}
_MOST_ENDS = 3
"""DOFs of a row that a name can hold."""


def _names(file: ElementRigFile) -> dict[Location, str]:
    """Names of all elements: their own, or their places; a number where two of one configuration would share one."""
    directions: dict[str, set[str]] = {}
    for entry in file.masses:
        body, _, direction = (entry.at or "").rpartition(".")
        directions.setdefault(body, set()).add(direction)
    names = {where: entry.name for where, entry in file.entries() if entry.name}
    taken = [(entry.name, entry) for _, entry in file.entries() if entry.name]
    for where, entry in file.entries():
        if entry.name:
            continue
        place, number = _place_name(where, entry, directions), 1
        name = place
        while any(name == other and _together(file, entry, e) for other, e in taken):
            number += 1
            name = f"{place} {number}"
        names[where] = name
        taken.append((name, entry))
    return names


def _together(file: ElementRigFile, a: ElementEntry, b: ElementEntry) -> bool:
    """True where two elements are there in the same configuration."""
    return any(file.present(a, c) and file.present(b, c) for c in file.configurations)


def _place_name(where: Location, entry: ElementEntry, directions: Mapping[str, set[str]]) -> str:
    """``b3 mass`` of a body that moves in one direction; else ``b3 mass x``, ``slab-b1 spring x``."""
    section, index = str(where[0]), int(where[1])
    ends = [entry.at] if entry.at else list(entry.between or entry.row or ())
    if section not in _WORDS or len(ends) > _MOST_ENDS:
        return f"{_WORDS.get(section, section)} {index + 1}"
    word = _WORDS[section]
    places = [end.rpartition(".") for end in ends]
    along = {direction for _, _, direction in places}
    if len(along) > 1:
        return f"{'-'.join(end.replace('.', ' ') for end in ends)} {word}"
    place = "-".join(body for body, _, _ in places)
    name = word if place == word else f"{place} {word}"
    (direction,) = along
    only = section == "masses" and direction in ALONG and len(directions.get(place, ())) == 1
    return name if only else f"{name} {direction}"


def _build(
    file: ElementRigFile, names: Mapping[Location, str], configuration: str, values: Mapping[str, float]
) -> Assembly:
    sensors = _sensors(file)
    elements: list[Element] = []
    dofs: dict[str, None] = {}
    bodies = _bodies(file, configuration)
    for where, entry in file.entries():
        if not file.present(entry, configuration):
            continue
        element = _element(str(where[0]), names[where], entry, _row(entry, sensors, where), values, sensors)
        if isinstance(element, Mass) and (body := _body(entry)) and bodies[body] > 1:
            element = replace(element, part=f"{body[0]} mass")
        elements.append(element)
        if isinstance(element, Mass):
            dofs |= dict.fromkeys(element.row)
    return Assembly(tuple(dofs), tuple(elements), sensors, values["modal_damping_ratio"])


_Body = tuple[str, float | str]


def _body(entry: ElementEntry) -> _Body | None:
    """Body and value of a mass that moves along an axis; None for any other."""
    body, _, direction = (entry.at or "").rpartition(".")
    return (body, entry.value) if body and direction in ALONG else None


def _bodies(file: ElementRigFile, configuration: str) -> Counter[_Body | None]:
    """Number of directions in which a body has the same mass: one piece of hardware, off alike in all of them."""
    entries = (e for where, e in file.entries() if where[0] == "masses" and file.present(e, configuration))
    return Counter(map(_body, entries))


def _element(
    section: str,
    name: str,
    entry: ElementEntry,
    row: Row,
    values: Mapping[str, float],
    sensors: Mapping[str, Row],
) -> Element:
    v = {key: values[x] if isinstance(x, str) else x for key, x in entry.numbers.items()}
    if section == "masses":
        return Mass(name, row, v["value"])
    if section == "springs":
        return Spring(name, row, v["value"], v["loss_factor"])
    if section == "dampers":
        return Damper(name, row, v["value"])
    if section == "gyroscopic":
        assert entry.between is not None
        a, b = (_place(text, sensors, ()) for text in entry.between)
        return Gyroscopic(name, a, b, v["value"])
    assert isinstance(entry, NonlinearEntry)
    element = _LAWS[entry.law](name, row, v)
    check_element(element)
    return element


_LAWS: dict[str, Callable[[str, Row, Mapping[str, float]], Nonlinear]] = {
    "quadratic": lambda name, row, v: PolynomialSpring(name, row, quadratic=v["value"]),
    "cubic": lambda name, row, v: PolynomialSpring(name, row, cubic=v["value"]),
    "friction": lambda name, row, v: DryFriction(name, row, v["value"], v["velocity"]),
    "contact": lambda name, row, v: PartingSpring(name, row, v["value"], preload=v["preload"], gap=v["gap"]),
    "hysteresis": lambda name, row, v: BoucWen(name, row, v["value"], v["rho"], v["sigma"], v["exponent"]),
    "relaxation": lambda name, row, v: Maxwell(name, row, v["value"], v["time"]),
}


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
    here = (*location, given[0])
    if entry.at is not None:
        return _place(entry.at, sensors, here)
    assert entry.between is not None
    first, second = entry.between
    row = difference(_place(first, sensors, here), _place(second, sensors, here))
    if _parsed_dof(first, here).point == _parsed_dof(second, here).point or not any(row.values()):
        raise Mistake(here, f"between '{first}' and '{second}' there is no stretch; name two places")
    return row


def _place(text: str, sensors: Mapping[str, Row], location: Location) -> Row:
    dof = _parsed_dof(text, location)
    return {d: dof.sign * c for d, c in sensors.get(dof.point, {dof.point: 1.0}).items()}


def _parsed_dof(text: str, location: Location) -> Dof:
    try:
        return Dof.parse(text)
    except EmaError as error:
        raise Mistake(location, str(error)) from None
