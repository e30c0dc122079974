"""What a rig is: parameters with tolerances, configurations, and the system that they build."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.system import LinearSystem

MODAL_DAMPING_SCATTER = 0.3
"""1 σ of ln ζ from mode to mode where a rig states none: joints damp modes without a law."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a rig.

    Attributes
    ----------
    name : str
        E.g. ``"sun_planet_mesh_stiffness"``.
    value : float
        Nominal value in `unit`.
    unit : str
    tolerance : float
        Relative standard deviation (1 σ) of the nominal value; 0 for exactly known.
    minimum, maximum : float
        Bounds.
    free : bool
        True where the nominal value is only a start and the data must determine the parameter
        (no prior but the bounds).
    scatter : float or None
        Relative standard deviation (1 σ) of single parts about the value that all like parts share; 0 where they
        are identical, None where nothing is stated.
    """

    name: str
    value: float
    unit: str
    tolerance: float = 0.0
    minimum: float = 0.0
    maximum: float = float("inf")
    free: bool = False
    scatter: float | None = None

    def __post_init__(self) -> None:
        for key in ("value", "tolerance", "minimum", "maximum"):
            number = getattr(self, key)
            if isinstance(number, bool) or not isinstance(number, Real) or math.isnan(number):
                raise EmaError(f"parameter '{self.name}': {key} = {number!r}: give a number")
        if math.isinf(self.value):
            raise EmaError(f"parameter '{self.name}': value = {self.value:g}: give a finite number")
        if not 0 <= self.tolerance < math.inf:
            raise EmaError(
                f"parameter '{self.name}': tolerance = {self.tolerance:g}: give 0 or more, relative, 1 σ"
            )
        if self.minimum > self.maximum:
            raise EmaError(
                f"parameter '{self.name}': minimum {self.minimum:g} is above maximum {self.maximum:g}; exchange them"
            )


@dataclass(frozen=True)
class ModelMode:
    """A mode of the analytical model.

    Attributes
    ----------
    index : int
    frequency_hz : float
    damping_ratio : float
    family : str
        ``"rotational"``, ``"translational"``, ``"planet"``, ``"rigid body"``, …
    shape : ndarray, (n,)
        Mass-normalised real shape at the system's coordinates.
    complex_shape : complex ndarray, (n,), or None
        Shape of the damped mode, scaled as in `mechanics.modes.ComplexModes`; None where damping does not
        couple the modes and `shape` says it all.
    """

    index: int
    frequency_hz: float
    damping_ratio: float
    family: str
    shape: NDArray[np.float64]
    complex_shape: NDArray[np.complex128] | None = None


class Rig(Protocol):
    """A rig: builds a system from parameter values for each of its configurations."""

    @property
    def name(self) -> str: ...

    @property
    def configurations(self) -> tuple[str, ...]: ...

    @property
    def parameters(self) -> Mapping[str, Parameter]: ...

    @property
    def modal_damping_scatter(self) -> float:
        """Standard deviation (1 σ) of ln ζ from mode to mode."""
        ...

    @property
    def stiffness_steps(self) -> tuple[tuple[str, str], ...]:
        """Configuration and stiffness of every step of a fit by frequencies alone; empty without such a route."""
        ...

    def used(self, configuration: str) -> tuple[str, ...]:
        """Names of the parameters that this configuration depends on."""
        ...

    def assembly(self, configuration: str, values: Mapping[str, float] | None = None) -> Assembly:
        """Named elements at `values` (nominal values where left out): what effects edit."""
        ...

    def system(self, configuration: str, values: Mapping[str, float] | None = None) -> LinearSystem:
        """System at `values` (nominal values where left out); EmaError for unknown names."""
        ...

    def knows(self, configuration: str, dof: Dof) -> bool:
        """True where a sensor or hammer can sit at `dof` in this configuration."""
        ...

    def classify(
        self, system: LinearSystem, frequency_hz: NDArray[np.float64], shapes: NDArray[np.float64]
    ) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """Family of every mode, and shapes rotated within equal frequencies to one family each."""
        ...
