"""Identified modes as a rig: the linear model of a test whose masses and springs nobody has stated."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.errors import EmaError
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.assembly import Assembly, Damper, Element, Mass, Row, Spring
from ema_pipeline.modal.types import ModalModel, Mode
from ema_pipeline.rigs.base import ParametricRig

NAME = "identified modes"
_RATIO = 0.03
"""Damping ratio of a peak that stands for a mode."""
_HIGH = 0.1
"""Height of a mode's peak, over the highest, from which the records need it: a tenth of a response is ten times what a
linear model explains them to."""


def rig_of_modes(modal: ModalModel, frfs: FrfSet, configuration: str, most: int) -> ParametricRig:
    """One mass, spring and damper per mode; its shape at every measured DOF is what sensors and forces see of it.

    Parameters
    ----------
    modal : ModalModel
    frfs : FrfSet
        Where no mode was identified, as of a strongly nonlinear rig, their largest peak stands for one.
    configuration : str
    most : int
        Modes that are kept, those with the largest motion first.

    Raises
    ------
    EmaError
        Without a driving point, which the masses follow from.
    """
    if reason := _unscaled(modal, frfs):
        raise EmaError(f"{configuration}: {reason}")
    if not modal.modes:
        return _rig_of_peak(frfs, configuration)
    kept = sorted(sorted(modal.modes, key=lambda m: -_peak(m))[:most], key=lambda m: m.frequency_hz)
    names = tuple(d.point for d in modal.dofs)
    numbers = tuple(
        (abs(m.pole) ** 2, -2 * m.pole.real, tuple(float(v) for v in _real_shape(m))) for m in kept
    )
    return ParametricRig(NAME, (configuration,), {}, partial(_build, names, numbers))


def why_no_rig(modal: ModalModel, frfs: FrfSet, most: int) -> str:
    """Why the identified modes are no linear model of the records, and what helps; empty where they are.

    Modes left out whose peaks are high would look like missing physics.
    """
    peaks = np.array([_peak(m) for m in modal.modes])
    high = int(np.count_nonzero(peaks >= _HIGH * np.max(peaks, initial=0.0)))
    if high > most:
        return (
            f"{high} modes take part in the response, and records are simulated with up to {most} coordinates; give a "
            "model of so few with --rig FILE.toml"
        )
    return _unscaled(modal, frfs)


def _unscaled(modal: ModalModel, frfs: FrfSet) -> str:
    if modal.modes and not modal.scaled:
        return (
            f"the modes have no scale ({modal.scaling_note}); measure the response where a force acts, or give a "
            "model with --rig FILE.toml"
        )
    if not modal.modes and not any(d in frfs.outputs for d in frfs.inputs):
        return (
            "no mode was identified and no response is measured where a force acts; give a model "
            "with --rig FILE.toml"
        )
    return ""


def _peak(mode: Mode) -> float:
    """Height of a mode's highest peak, φ²/σ."""
    return float(np.nanmax(np.abs(mode.shape)) ** 2 / abs(mode.pole.real))


def _rig_of_peak(frfs: FrfSet, configuration: str) -> ParametricRig:
    """One mode at the largest response of a driving point, with a usual damping: the search goes on from there."""
    driven = next(d for d in frfs.inputs if d in frfs.outputs)
    low, high = np.searchsorted(frfs.frequency_hz, frfs.band_hz)
    inside = slice(max(int(low), 1), max(int(high), int(low) + 2))
    response = frfs.accelerance(inside)[:, frfs.inputs.index(driven)]
    own = np.abs(response[frfs.outputs.index(driven)])
    peak = int(np.argmax(own))
    omega = 2 * np.pi * float(frfs.frequency_hz[inside][peak])
    at = response[:, peak] / response[frfs.outputs.index(driven), peak]
    scale = np.sqrt(2 * _RATIO * float(own[peak]))  # accelerance φ²/(2ζ) at the peak of a mode
    shape = tuple(float(scale * v) for v in at.real)
    names = tuple(d.point for d in frfs.outputs)
    numbers = ((omega**2, 2 * _RATIO * omega, shape),)
    return ParametricRig(NAME, (configuration,), {}, partial(_build, names, numbers))


def _real_shape(mode: Mode) -> NDArray[np.float64]:
    """The shape turned to where it is most nearly real; 0 where not measured."""
    shape = np.nan_to_num(mode.shape)
    return np.asarray((shape * np.exp(-0.5j * np.angle(np.sum(shape**2)))).real)


def _build(
    dofs: tuple[str, ...],
    modes: tuple[tuple[float, float, tuple[float, ...]], ...],
    configuration: str,
    values: Mapping[str, float],
) -> Assembly:
    elements: list[Element] = []
    sensors: dict[str, dict[str, float]] = {d: {} for d in dofs}
    for k, (square, decay, shape) in enumerate(modes):
        own: Row = {f"mode{k + 1}.q": 1.0}
        name = f"mode {k + 1}"
        elements += [Mass(name, own, 1.0), Spring(name, own, square), Damper(name, own, decay)]
        for dof, value in zip(dofs, shape, strict=True):
            sensors[dof][f"mode{k + 1}.q"] = value
    return Assembly(tuple(f"mode{k + 1}.q" for k in range(len(modes))), tuple(elements), sensors)
