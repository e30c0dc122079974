"""Size of motion and force in a test, from which the sizes to expect of effects follow."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ema_pipeline.effects.base import EffectParameter, PlacedEffect
from ema_pipeline.observations.size_map import SizeMap

SIZE_SHARE = 0.5
"""Prior 1 σ of an effect's force as a share of the measured one."""
START_SHARE = 0.1
"""Share of the measured force from which a fit of an effect starts."""
FRICTION_RATE = 0.02
"""Rate, as a share of the largest, at which dry friction has reached most of its force: a regularisation."""


@dataclass(frozen=True)
class Typical:
    """Size of a motion and of the force that goes with it.

    Attributes
    ----------
    amplitude_m : float
    omega : float
        Angular frequency, rad/s.
    force_n : float
        Restoring force at that amplitude.
    """

    amplitude_m: float
    omega: float
    force_n: float

    def size(self, unit: str) -> float | None:
        """Size of a quantity that makes a force as large as the measured one; None where its unit does not tell."""
        x, omega, force = self.amplitude_m, self.omega, self.force_n
        return {
            "N": force,
            "N/m": force / x,
            "N/m²": force / x**2,
            "N/m³": force / x**3,
            "N·s/m": force / (x * omega),
            "N·s²/m²": force / (x * omega) ** 2,
            "m": x,
            "1/m": 1 / x,
            "m/s": FRICTION_RATE * x * omega,
            "s": 1 / omega,
        }.get(unit)

    def scaled(self, placed: PlacedEffect) -> PlacedEffect:
        """An effect with the starts and prior scales of its sizes as this force and motion suggest."""
        parameters = tuple(self._scaled(p) for p in placed.effect.parameters)
        return dataclasses.replace(placed, effect=dataclasses.replace(placed.effect, parameters=parameters))

    def _scaled(self, p: EffectParameter) -> EffectParameter:
        typical = self.size(p.unit)
        if typical is None:
            return p
        if SizeMap.of(p, p.scale).logarithmic:
            centre = float(np.clip(typical, p.minimum, p.maximum))
            return dataclasses.replace(p, null=centre, start=centre)
        sign = -1.0 if p.start < p.null else 1.0
        return dataclasses.replace(p, start=p.null + sign * START_SHARE * typical, scale=SIZE_SHARE * typical)
