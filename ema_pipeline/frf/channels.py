"""How well each channel of a test is calibrated, as a later stage asks for it: by DOF, or for the hammer."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ema_pipeline.dof import Dof
from ema_pipeline.ingest.defaults import CALIBRATION_STD, TRANSVERSE

if TYPE_CHECKING:
    from ema_pipeline.frf.types import FrfSet

SEVERAL = " + "
"""Stands between the names of sensors that have measured one and the same DOF."""
OFF_DIRECTION = 0.1
"""1 σ, in rad, of the direction of all blows on one DOF together: two of them, each 8° off."""


@dataclass(frozen=True)
class ChannelQuality:
    """Uncertainty of one channel.

    Attributes
    ----------
    name : str
        Name of the channel. The same name at several DOFs is one roving sensor, which has one gain; where several
        sensors have measured a DOF, all their names; empty where unknown.
    calibration_std : float
        Relative 1 σ of the sensitivity.
    transverse : float
        Transverse sensitivity as a share of the main one, 1 σ.
    """

    name: str = ""
    calibration_std: float = CALIBRATION_STD
    transverse: float = TRANSVERSE
    off_direction: ClassVar[float] = 0.0
    """1 σ, in rad, of the direction in which blows read a DOF; that of a sensor is in `transverse`."""
    aim: ClassVar[float] = 0.0
    """Relative 1 σ of how much of a blow its direction lets act, for all modes alike."""

    @property
    def sensors(self) -> list[str]:
        """Names of the sensors that have measured there."""
        return self.name.split(SEVERAL)


@dataclass(frozen=True)
class InTurn(ChannelQuality):
    """Uncertainty of a DOF to which a sensor was moved: it has blows of its own."""

    aim = math.sqrt(2) * OFF_DIRECTION**2  # of 1 - cos, off in two directions, two blows


@dataclass(frozen=True)
class StruckPoint(InTurn):
    """Uncertainty of a DOF that was struck and carried no sensor: the direction of the blows is what is read."""

    off_direction = OFF_DIRECTION


def channel_uncertainty(frfs: FrfSet | None, dof: Dof) -> ChannelQuality:
    """Uncertainty of what was measured at a DOF of one configuration.

    Parameters
    ----------
    frfs : FrfSet or None
        FRFs of the configuration; None for a table of modes, of whose sensors nothing is known.
    dof : Dof
        A DOF of the FRFs or of the modes that were identified from them; its sign does not matter.

    Returns
    -------
    ChannelQuality
        Of the sensor at that DOF, `InTurn` where it has measured others, too; a `StruckPoint` of the hammer where the
        DOF was struck but carried no sensor (a roving hammer, whose one gain is common to all such DOFs); the defaults
        where nothing is known.
    """
    if frfs is None:
        return ChannelQuality()
    for output, channel in zip(frfs.outputs, frfs.channels, strict=False):
        if output.point == dof.point:
            moved = moved_sensors(frfs) & set(channel.sensors)
            return InTurn(channel.name, channel.calibration_std, channel.transverse) if moved else channel
    if dof.point in {d.point for d in frfs.inputs} - {d.point for d in frfs.outputs}:
        hammer = hammer_uncertainty(frfs)
        return StruckPoint(hammer.name, hammer.calibration_std, hammer.transverse)
    return ChannelQuality()


def moved_sensors(frfs: FrfSet) -> set[str]:
    """Names of the sensors that have measured several outputs."""
    names = Counter(name for channel in frfs.channels for name in channel.sensors if name)
    return {name for name, count in names.items() if count > 1}


def hammer_uncertainty(frfs: FrfSet | None) -> ChannelQuality:
    """Uncertainty of the force channel of one configuration; the defaults where nothing is known."""
    return ChannelQuality() if frfs is None or frfs.hammer is None else frfs.hammer


def merged(one: ChannelQuality | None, other: ChannelQuality) -> ChannelQuality:
    """Uncertainty of a DOF at which two records were taken: never better than that of either sensor."""
    if one is None or one == other:
        return other
    names = list(dict.fromkeys([*one.sensors, other.name]))
    worse = max(one, other, key=lambda channel: (channel.off_direction, channel.aim))
    return type(worse)(
        SEVERAL.join(names),
        max(one.calibration_std, other.calibration_std),
        max(one.transverse, other.transverse),
    )


def uncertainty_of_dofs(
    measured: Iterable[tuple[FrfSet | None, Iterable[Dof]]],
) -> dict[str, ChannelQuality]:
    """Uncertainty of every DOF of several configurations, by point.

    Parameters
    ----------
    measured : iterable of (FrfSet or None, iterable of Dof)
        FRFs of each configuration, or None for a table of modes, with the DOFs that were measured.
    """
    found: dict[str, ChannelQuality] = {}
    for frfs, dofs in measured:
        for dof in dofs:
            found[dof.point] = merged(found.get(dof.point), channel_uncertainty(frfs, dof))
    return found
