"""A rig made of parameters and a function that assembles its elements from their values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.modes import complex_modes, damping_ratios, normal_modes
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.drawing import Draw, no_drawing
from ema_pipeline.rigs.types import MODAL_DAMPING_SCATTER, ModelMode, Parameter, Rig

Build = Callable[[str, Mapping[str, float]], Assembly]
Families = tuple[tuple[str, ...], NDArray[np.float64]]
Classify = Callable[[LinearSystem, NDArray[np.float64], NDArray[np.float64]], Families]


def classify_plain(
    system: LinearSystem, frequency_hz: NDArray[np.float64], shapes: NDArray[np.float64]
) -> Families:
    """Families of a rig without symmetry: ``"rigid body"`` at 0 Hz, ``"elastic"`` above."""
    return tuple("rigid body" if f == 0.0 else "elastic" for f in frequency_hz), shapes


def no_extra(name: str, geometry: Mapping[str, int]) -> Parameter | None:
    """A kind of rig whose files cannot add parameters."""
    return None


def uses_everything(configuration: str, name: str) -> bool:
    """Every configuration depends on every parameter."""
    return True


@dataclass(frozen=True)
class ParametricRig:
    """A rig: parameters with tolerances, and functions that turn their values into elements.

    Attributes
    ----------
    name : str
    configurations : tuple of str
    parameters : dict of str to Parameter
    build : callable
        ``build(configuration, values) -> Assembly``; a module-level function or a partial of one, so that
        the rig can be sent to another process.
    uses : callable
        ``uses(configuration, parameter name) -> bool``.
    classifier : callable
        See `Rig.classify`.
    modal_damping_scatter : float
        Standard deviation (1 σ) of ln ζ from mode to mode.
    stiffness_steps : tuple of (str, str)
        Configuration and stiffness of every step of a fit by frequencies alone, one after the other; empty without one.
    """

    name: str
    configurations: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    build: Build
    uses: Callable[[str, str], bool] = uses_everything
    classifier: Classify = classify_plain
    modal_damping_scatter: float = MODAL_DAMPING_SCATTER
    stiffness_steps: tuple[tuple[str, str], ...] = ()

    def used(self, configuration: str) -> tuple[str, ...]:
        """Names of the parameters that this configuration depends on."""
        self._check(configuration)
        return tuple(name for name in self.parameters if self.uses(configuration, name))

    def assembly(self, configuration: str, values: Mapping[str, float] | None = None) -> Assembly:
        """Elements at `values` (nominal values where left out).

        Raises
        ------
        EmaError
            For an unknown configuration or an unknown parameter, or where `build` asks for another one or gives no
            assembly.
        """
        self._check(configuration)
        complete = {name: p.value for name, p in self.parameters.items()}
        for name, value in (values or {}).items():
            if name not in complete:
                raise EmaError(f"rig '{self.name}' has no parameter '{name}'{did_you_mean(name, complete)}")
            complete[name] = float(value)
        try:
            found = self.build(configuration, complete)
        except KeyError as error:
            known = ", ".join(f"'{n}'" for n in complete) or "none"
            raise EmaError(
                f"rig '{self.name}': build asks for {error}, the parameters are {known}; name them alike"
            ) from error
        if not isinstance(found, Assembly):
            kind = type(found).__name__
            raise EmaError(
                f"rig '{self.name}': build gives {kind} for '{configuration}'; let it return an Assembly"
            )
        return found

    def system(self, configuration: str, values: Mapping[str, float] | None = None) -> LinearSystem:
        """Matrices at `values` (nominal values where left out)."""
        return self.assembly(configuration, values).system()

    def knows(self, configuration: str, dof: Dof) -> bool:
        """True where a sensor or hammer can sit at `dof` in this configuration."""
        return self.assembly(configuration).has_dof(dof.point)

    def classify(
        self, system: LinearSystem, frequency_hz: NDArray[np.float64], shapes: NDArray[np.float64]
    ) -> Families:
        """Family of every mode, and shapes rotated within equal frequencies to one family each."""
        return self.classifier(system, frequency_hz, shapes)

    def _check(self, configuration: str) -> None:
        if configuration not in self.configurations:
            raise EmaError(
                f"rig '{self.name}' has no configuration '{configuration}'"
                f"{did_you_mean(configuration, self.configurations)}"
            )


def model_modes(
    rig: Rig, configuration: str, values: Mapping[str, float] | None = None
) -> tuple[ModelMode, ...]:
    """Modes of the rig's model, in order of frequency, with damping and family.

    Where dampers, loss factors or gyroscopic coupling do more than give every mode its damping ratio, the
    damped system's own poles are taken: frequency |s|/2π and the complex shape, of which `shape` is the
    real part after rotation to the real axis.
    """
    return modes_of(rig, rig.system(configuration, values))


def modes_of(rig: Rig, system: LinearSystem) -> tuple[ModelMode, ...]:
    """Modes of a system of the rig, see `model_modes`."""
    frequency_hz, shapes = normal_modes(system)
    families, shapes = rig.classify(system, frequency_hz, shapes)
    if not np.any(system.damping) and not np.any(system.structural):
        ratios = damping_ratios(system, frequency_hz, shapes)
        return tuple(
            ModelMode(i, float(frequency_hz[i]), float(ratios[i]), families[i], shapes[:, i].copy())
            for i in range(len(families))
        )
    damped = complex_modes(system)
    if not damped.poles.size:
        raise EmaError(
            f"rig '{rig.name}': its damping lets no mode vibrate; correct dampers and loss factors"
        )
    frequency_hz = damped.frequency_hz
    real = np.stack([_real_shape(v, system.mass) for v in damped.shapes.T], axis=1)
    families, _ = rig.classify(system, frequency_hz, real)
    return tuple(
        ModelMode(i, float(f), float(z), families[i], real[:, i].copy(), damped.shapes[:, i].copy())
        for i, (f, z) in enumerate(zip(frequency_hz, damped.damping_ratio, strict=True))
    )


def _real_shape(shape: NDArray[np.complex128], mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mass-normalised real part after turning the shape to the real axis as far as it goes."""
    turned = shape * np.exp(-0.5j * np.angle(shape @ mass @ shape))
    real = turned.real
    return np.asarray(real / np.sqrt(real @ mass @ real))


MOST = 200
"""Planets, storeys …: more are a slip of the hand, and their matrices would fill the memory."""


def check_count(what: str, parts: str, count: int, least: int) -> None:
    """EmaError where a rig's number of parts makes no sense."""
    if count < least:
        raise EmaError(f"a {what} needs at least {least} {parts}, not {count}; set {parts} = {least} or more")
    if count > MOST:
        raise EmaError(f"{parts} = {count}: a {what} can have {MOST} at most")


@dataclass(frozen=True)
class RigKind:
    """A kind of rig that rig files can name as their base; one per module of this package, as ``RIG``.

    Attributes
    ----------
    name, title : str
        Name on the command line and a line for the list of rigs.
    make : callable
        ``make(geometry, parameters) -> Rig`` with complete geometry and the parameters that a file changes.
    geometry : dict of str to int
        Names and defaults of the counts that a rig file may set.
    parameters : callable
        ``parameters(geometry) -> dict`` of the default parameters.
    extra : callable
        ``extra(name, geometry)``: a parameter that a file may add to the defaults, or None.
    drawing : callable
        ``drawing(points, complete)``: how the rig is drawn, see `drawing.Draw`.
    """

    name: str
    title: str
    make: Callable[[Mapping[str, int], Mapping[str, Parameter]], Rig]
    geometry: Mapping[str, int]
    parameters: Callable[[Mapping[str, int]], dict[str, Parameter]]
    extra: Callable[[str, Mapping[str, int]], Parameter | None] = no_extra
    drawing: Draw = no_drawing
