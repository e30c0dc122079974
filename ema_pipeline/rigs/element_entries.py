"""How a rig file lists masses, springs, dampers and nonlinear elements."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from ema_pipeline.rigs.entries import Number, NumberOrName, ParameterOrNumber
from ema_pipeline.rigs.types import MODAL_DAMPING_SCATTER
from ema_pipeline.settings import Settings
from ema_pipeline.toml_lines import Location

SECTIONS = ("masses", "springs", "dampers", "gyroscopic", "nonlinear")


def _flat(row: Any) -> Any:
    """``row = { top.x = 1.0 }`` is the same as ``row = { "top.x" = 1.0 }``."""
    if not isinstance(row, dict):
        return row
    flat: dict[str, Any] = {}
    for key, value in row.items():
        # An empty table stays what it is, so that it is refused as a coefficient and not left out.
        inner = (
            {f"{key}.{k}": v for k, v in value.items()} if value and isinstance(value, dict) else {key: value}
        )
        for dof in inner:
            if dof in flat:
                raise ValueError(f"'{dof}' has two coefficients; give it one")
        flat |= inner
    return flat


def _moves(row: dict[str, float]) -> dict[str, float]:
    if not any(row.values()):
        raise ValueError("name at least one dof with a coefficient other than 0, e.g. { 'plate.x' = 1.0 }")
    return row


Coefficients = Annotated[dict[str, Number], BeforeValidator(_flat), AfterValidator(_moves)]


class ElementEntry(Settings):
    """A mass, spring or damper at one DOF, between two, or along a row of coefficients."""

    name: str | None = Field(None, description="name that effects and messages use")
    at: str | None = Field(None, description="DOF, to ground: 'plate.x'")
    between: tuple[str, str] | None = Field(None, description="two DOFs: ['plate.x', 'base.x']")
    row: Coefficients | None = Field(None, description="coefficients of the stretch over DOFs")
    value: NumberOrName = Field(description="number, or the name of a parameter")
    unit: str | None = Field(None, description="unit of a number in `value`; SI where left out")
    configurations: tuple[str, ...] = Field((), description="only in these configurations; all if empty")

    @field_validator("between", mode="before")
    @classmethod
    def _two(cls, given: object) -> object:
        if given is not None and (not isinstance(given, list | tuple) or len(given) != 2):
            raise ValueError("name two DOFs, e.g. ['plate.x', 'base.x']")
        return given

    @property
    def numbers(self) -> dict[str, float | str]:
        """All numbers, or the names of parameters in their places."""
        return {"value": self.value}

    @property
    def lacks(self) -> str | None:
        """A key that the element needs and does not have."""
        return None


class SpringEntry(ElementEntry):
    """A spring, with loss where it is not lossless."""

    loss_factor: NumberOrName = Field(0.0, description="imaginary over real stiffness")

    @property
    def numbers(self) -> dict[str, float | str]:
        """See `ElementEntry`."""
        return {"value": self.value, "loss_factor": self.loss_factor}


class GyroscopicEntry(ElementEntry):
    """Lossless skew coupling of the two DOFs in `between`."""

    @property
    def lacks(self) -> str | None:
        """See `ElementEntry`."""
        return "between" if self.between is None else None


Law = Literal["quadratic", "cubic", "friction", "contact", "hysteresis", "relaxation"]
_NEEDS: dict[Law, tuple[str, ...]] = {
    "quadratic": (),
    "cubic": (),
    "friction": (),
    "contact": ("preload",),
    "hysteresis": ("rho", "sigma"),
    "relaxation": ("time",),
}


class NonlinearEntry(ElementEntry):
    """An element with a law of `mechanics.laws`; `value` is its factor, stiffness or force."""

    law: Law = Field(description="what its force follows")
    velocity: NumberOrName = Field(1e-3, description="friction: below it creeps, m/s")
    preload: NumberOrName | None = Field(None, description="contact: deflection beyond which it separates, m")
    gap: NumberOrName = Field(1e3, description="contact: gap to its back, m")
    rho: NumberOrName | None = Field(None, description="hysteresis: 1/m")
    sigma: NumberOrName | None = Field(None, description="hysteresis: shape of the unloading branch")
    exponent: NumberOrName = Field(1.0, description="hysteresis: sharpness of the yield")
    time: NumberOrName | None = Field(None, description="relaxation: damper over spring, s")

    @property
    def numbers(self) -> dict[str, float | str]:
        """See `ElementEntry`."""
        keys = ("value", "velocity", "preload", "gap", "rho", "sigma", "exponent", "time")
        return {k: v for k in keys if (v := getattr(self, k)) is not None}

    @property
    def lacks(self) -> str | None:
        """See `ElementEntry`."""
        return next((key for key in _NEEDS[self.law] if getattr(self, key) is None), None)


class SensorEntry(Settings):
    """A sensor place that is no coordinate of its own."""

    dof: str = Field(description="place, 'plate.corner'")
    row: Coefficients = Field(description="coefficients of what the sensor reads over the coordinates")


class ElementRigFile(Settings):
    """A rig file from scratch: its coordinates are the DOFs of its masses."""

    name: str = Field("rig of elements", min_length=1, description="name of the rig")
    configurations: tuple[str, ...] = Field(("default",), min_length=1, description="configurations")
    modal_damping_ratio: float = Field(
        0.01, ge=0, lt=1, description="damping ratio of every mode, 30 % tolerance"
    )
    modal_damping_scatter: float = Field(
        MODAL_DAMPING_SCATTER, ge=0, le=3, description="1 sigma of ln(damping ratio) from mode to mode"
    )
    parameters: dict[str, ParameterOrNumber] = Field({}, description="values, with unit and tolerance")
    masses: tuple[ElementEntry, ...] = Field(min_length=1, description="masses, kg")
    springs: tuple[SpringEntry, ...] = Field((), description="springs, N/m")
    dampers: tuple[ElementEntry, ...] = Field((), description="viscous dampers, N·s/m")
    gyroscopic: tuple[GyroscopicEntry, ...] = Field((), description="skew couplings, N·s/m")
    nonlinear: tuple[NonlinearEntry, ...] = Field((), description="elements with a law of their own")
    sensors: tuple[SensorEntry, ...] = Field((), description="further sensor places")

    def entries(self) -> Iterator[tuple[Location, ElementEntry]]:
        """All elements with their places in the file."""
        for section in SECTIONS:
            for i, entry in enumerate(getattr(self, section)):
                yield (section, i), entry

    def present(self, entry: ElementEntry, configuration: str) -> bool:
        """True where the element is there in this configuration."""
        return configuration in (entry.configurations or self.configurations)
