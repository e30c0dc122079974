"""How far a simulated rig and its test are from ideal, and the two levels that have names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Level = Literal["none", "good", "normal"]
DriftKind = Literal["independent", "walk"]

LARGEST_DEVIATION = 3.0
"""Draws are cut at so many σ: a part further off would not have passed its inspection."""


@dataclass(frozen=True)
class Imperfections:
    """Standard deviations (1 σ) of what no model of the rig knows; zero for an ideal rig and test.

    Attributes
    ----------
    part_scatter : float
        Of ln stiffness of each spring; masses scatter by a quarter of it.
    calibration : float
        Of ln gain of each channel.
    transverse : float
        Share of the perpendicular motion that an accelerometer reads.
    aim_deg : float
        Direction of each hit, degrees.
    drift : float
        Relative change of all natural frequencies from hit to hit.
    damping_scatter : float
        Of ln ζ from mode to mode.
    """

    part_scatter: float = 0.0
    calibration: float = 0.0
    transverse: float = 0.0
    aim_deg: float = 0.0
    drift: float = 0.0
    damping_scatter: float = 0.0

    @property
    def of_hits(self) -> bool:
        """True where hits of one point differ in more than their force, or sensors read more than their axis."""
        return bool(self.transverse or self.aim_deg or self.drift)

    @property
    def none(self) -> bool:
        """True for an ideal rig and test."""
        return self == Imperfections()


LEVELS: dict[Level, Imperfections] = {
    "none": Imperfections(),
    "good": Imperfections(0.01, 0.01, 0.02, 2.0, 0.0002, 0.2),
    "normal": Imperfections(0.03, 0.04, 0.05, 8.0, 0.001, 0.5),
}
"""A laboratory that takes great care, and a usual one."""

Purpose = Literal["parts", "gains", "transverse", "sensor angle", "hits", "damping"]
_PURPOSES: tuple[Purpose, ...] = ("parts", "gains", "transverse", "sensor angle", "hits", "damping")


def generator(seed: int, purpose: Purpose, configuration: int = 0) -> np.random.Generator:
    """Random numbers of one purpose.

    Each purpose has its own, so that one imperfection can be changed while the others, and the noise, stay.
    """
    return np.random.default_rng([seed, 1 + _PURPOSES.index(purpose), configuration])


def deviations(random: np.random.Generator, count: int) -> list[float]:
    """Standard normal numbers within `LARGEST_DEVIATION`."""
    return [float(z) for z in np.clip(random.standard_normal(count), -LARGEST_DEVIATION, LARGEST_DEVIATION)]
