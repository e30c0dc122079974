"""How the size of an effect follows from its unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ema_pipeline.effects.base import EffectParameter
from ema_pipeline.inference import Posterior

LOG_STD = 1.2
"""Prior 1 σ of the logarithm of a size that has no null: within a factor of three of its start, mostly."""
_AS_BEFORE = 0.95
"""Share of its prior 1 σ that such a size keeps, from which the data tell nothing of it."""


@dataclass(frozen=True)
class SizeMap:
    """How one size of an effect follows from its unknown: value = null + scale·x, or start·exp(1.2 x)."""

    parameter: EffectParameter
    scale: float
    logarithmic: bool

    @classmethod
    def of(cls, parameter: EffectParameter, scale: float) -> SizeMap:
        """Logarithmic where the size has no finite null within its range, or cannot be zero."""
        no_null = not np.isfinite(parameter.null) or not parameter.minimum <= parameter.null
        return cls(parameter, scale, no_null or parameter.minimum > 0)

    def value(self, x: float) -> float:
        """Size at the unknown `x`, within its range."""
        p = self.parameter
        value = p.start * self.coordinate(x) if self.logarithmic else p.null + self.scale * x
        return float(np.clip(value, p.minimum, p.maximum))

    def unknown(self, value: float) -> float:
        """The unknown at which the size is `value`."""
        p = self.parameter
        if self.logarithmic:
            return self.of_coordinate(max(value, 1e-300) / p.start)
        return (value - p.null) / self.scale

    def slope(self, x: float) -> float:
        """Derivative of the size by the unknown."""
        return self.value(x) * LOG_STD if self.logarithmic else self.scale

    def coordinate(self, x: float) -> float:
        """What a size is linear in: the unknown itself, or the size over its start."""
        return float(np.exp(LOG_STD * x)) if self.logarithmic else x

    def of_coordinate(self, z: float) -> float:
        """The unknown at a coordinate."""
        return float(np.log(z)) / LOG_STD if self.logarithmic else z

    def coordinate_slope(self, x: float) -> float:
        """Derivative of the coordinate by the unknown."""
        return LOG_STD * self.coordinate(x) if self.logarithmic else 1.0

    def learned(self, posterior: Posterior, unknown: int) -> bool:
        """False where the data tell nothing of a size that has no null: what is stated of it is its prior."""
        return not self.logarithmic or bool(
            posterior.std[unknown] < _AS_BEFORE * posterior.prior_std[unknown]
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """Range of the unknown."""
        p = self.parameter
        low = self.unknown(p.minimum) if p.minimum > 0 or not self.logarithmic else -np.inf
        return low, self.unknown(p.maximum)
