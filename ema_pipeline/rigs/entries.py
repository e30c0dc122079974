"""What all rig files share: parameters as a file states them, and mistakes that know their place in the file."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, ValidationError

from ema_pipeline.errors import EmaError
from ema_pipeline.rigs.types import Parameter
from ema_pipeline.rigs.units import factor_to
from ema_pipeline.settings import Settings, parse
from ema_pipeline.toml_lines import Location

M = TypeVar("M", bound=BaseModel)
LARGEST_TOLERANCE = 3.0

MODAL_DAMPING_RATIO = "modal_damping_ratio"
"""Parameter of every rig: the damping ratio of all modes."""

DAMPER_UNIT = "N·s/m"
"""Unit by which parameters of shipped rigs are known to be those of dampers."""

LARGEST_LOSS_FACTOR = 10.0
"""Rubber and viscoelastic layers reach about 2; a larger number is a percentage or a slip of the pen."""

SMALLEST, LARGEST = 1e-30, 1e30
"""SI units, of whatever is not 0; products of numbers beyond these leave the range of double precision."""


def _of_a_size(number: float) -> float:
    if number and not SMALLEST <= abs(number) <= LARGEST:
        raise ValueError(f"give 0, or a number from {SMALLEST:g} to {LARGEST:g} in size")
    return number


def _number_or_name(given: object) -> object:
    if isinstance(given, bool) or not isinstance(given, int | float | str):
        raise ValueError("give a number, or the name of a parameter")
    return given if isinstance(given, str) else _of_a_size(given)


Number = Annotated[float, AfterValidator(_of_a_size)]
NumberOrName = Annotated[float | str, BeforeValidator(_number_or_name)]


class Mistake(Exception):
    """Something wrong at a place of a rig file; the reader puts file and line in front."""

    def __init__(self, location: Location, message: str) -> None:
        super().__init__(message)
        self.location = location


class ParameterEntry(Settings):
    """One parameter of a rig file; what is left out keeps its default."""

    value: Number | None = Field(None, description="nominal value in `unit`")
    unit: str | None = Field(None, description="unit of value, min and max; converted to the rig's")
    tolerance: float | None = Field(
        None, ge=0, description="relative standard deviation of the nominal value"
    )
    scatter: float | None = Field(
        None, ge=0, le=1, description="relative standard deviation of single parts about the common value"
    )
    min: float | None = Field(None, description="lower bound")
    max: float | None = Field(None, description="upper bound")
    free: bool | None = Field(None, description="true where the data alone must determine the parameter")


def _number_is_a_value(given: object) -> object:
    """``sun_mass = 2.0`` is short for ``sun_mass = { value = 2.0 }``."""
    if isinstance(given, dict | ParameterEntry):
        return given
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise ValueError("give a number, or a table such as { value = 2.0, unit = 'kg', tolerance = 0.1 }")
    return {"value": given}


ParameterOrNumber = Annotated[ParameterEntry, BeforeValidator(_number_is_a_value)]


def parsed(model: type[M], data: dict[str, Any]) -> M:
    """A rig file's content as `model`.

    Raises
    ------
    Mistake
        For unknown keys, wrong types and values out of range.
    """
    try:
        return parse(model, data, "")
    except EmaError as error:
        message = str(error).removeprefix(":").strip()
        try:
            model.model_validate(data)
        except ValidationError as details:
            raise Mistake(details.errors()[0]["loc"], message) from None
        raise


def merged(default: Parameter, given: ParameterEntry) -> Parameter:
    """The default parameter with what the file says instead; a stated tolerance makes it a known one.

    Raises
    ------
    Mistake
        For another unit, and values that contradict each other.
    """
    name = default.name
    here: Location = ("parameters", name)
    unit = "" if default.unit == "1" else f" {default.unit}"
    factor = 1.0
    if given.unit is not None:
        factor = factor_to(given.unit, default.unit) or 0.0
        if not factor:
            raise Mistake(
                (*here, "unit"),
                f"parameter '{name}' has unit '{given.unit}', which is not one of '{default.unit}' or its multiples",
            )
    if given.tolerance is not None and given.tolerance > LARGEST_TOLERANCE:
        raise Mistake(
            (*here, "tolerance"),
            f"parameter '{name}' has tolerance {given.tolerance:g}, which is {100 * given.tolerance:g} %; "
            f"tolerances are relative: 10 % is 0.10",
        )
    free = given.free if given.free is not None else default.free and given.tolerance is None
    minimum = default.minimum if given.min is None else factor * given.min
    maximum = default.maximum if given.max is None else factor * given.max
    if minimum > maximum:
        raise Mistake(
            (*here, "max" if given.max is not None else "min"),
            f"parameter '{name}' has min {minimum:g}{unit} above max {maximum:g}{unit}; exchange them",
        )
    result = Parameter(
        name=name,
        value=default.value if given.value is None else factor * given.value,
        unit=default.unit,
        tolerance=default.tolerance if given.tolerance is None else given.tolerance,
        minimum=minimum,
        maximum=maximum,
        free=free,
        scatter=default.scatter if given.scatter is None else given.scatter,
    )
    if not result.minimum <= result.value <= result.maximum:
        raise Mistake(
            (*here, "value"),
            f"parameter '{name}' = {result.value:g}{unit} lies outside its bounds "
            f"{result.minimum:g} … {result.maximum:g}; change value, min or max",
        )
    if default.unit == "kg" and result.value <= 0:
        raise Mistake((*here, "value"), f"parameter '{name}' = {result.value:g}{unit}: give a mass above 0")
    if name == MODAL_DAMPING_RATIO and not (minimum >= 0 and result.value < 1):
        raise Mistake(
            (*here, "min" if minimum < 0 else "value"),
            f"parameter '{name}' = {result.value:g}, from {minimum:g} on: a damping ratio lies from 0 to below 1",
        )
    return result


def check_damper(parameter: Parameter) -> None:
    """Make sure that a parameter of dampers takes no energy below 0; that of a gyroscopic coupling has either sign.

    Raises
    ------
    Mistake
        Names its lower bound, which holds for its value too.
    """
    if parameter.minimum < 0:
        raise Mistake(
            ("parameters", parameter.name, "min"),
            f"parameter '{parameter.name}' has min {parameter.minimum:g} {parameter.unit}: a damper cannot be "
            "negative; give min = 0 or more",
        )
