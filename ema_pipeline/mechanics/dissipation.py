"""Dampers whose force grows with the square of the rate, and hysteresis that may soften or harden as it is loaded.

References
----------
Y.-K. Wen, Method for random vibration of hysteretic systems, J. Eng. Mech. Div. ASCE 102 (1976) 249-263.
J. P. Noel, M. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop on Nonlinear System
Identification Benchmarks (2016): a Bouc-Wen oscillator whose loops harden.
"""

from __future__ import annotations

from dataclasses import dataclass

from ema_pipeline.mechanics.laws import Nonlinear, Row, Step


@dataclass(frozen=True)
class SquareDamper(Nonlinear):
    """Force coefficient·|δ̇|·δ̇, as of a fluid that is displaced; N·s²/m²."""

    name: str
    row: Row
    coefficient: float

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`."""
        return self.coefficient * abs(rate) * rate, 0.0, 2 * self.coefficient * abs(rate), 0.0


@dataclass(frozen=True)
class HystereticSpring(Nonlinear):
    """Bouc-Wen force z, ż = stiffness·(δ̇ - |δ̇|·|u|ⁿ⁻¹·u - shape·δ̇·|u|ⁿ) with u = z/force.

    Attributes
    ----------
    stiffness : float
        At small motions, which the linear system holds, N/m.
    force : float
        Scale of the force, N. For shape 0 it is what the force tends to.
    shape : float
        Above -1 the force tends to force/(1 + shape)^(1/n) as it is loaded; below -1 it hardens. The normalised
        form of `laws.BoucWen` has limit = that force, σ = 1/(1 + shape), and holds for shapes above -1 only.
    exponent : float
        n ≥ 1: the larger, the sharper the yield.
    """

    name: str
    row: Row
    stiffness: float
    force: float
    shape: float = 0.0
    exponent: float = 1.0

    @property
    def tangent_stiffness(self) -> float:
        """Stiffness at small motions, N/m."""
        return self.stiffness

    def slope(self, z: float, direction: float) -> float:
        """dz/dδ for motion in `direction` (±1), N/m."""
        u = z / self.force
        towards = direction if u >= 0 else -direction
        return self.stiffness * (1.0 - (towards + self.shape) * abs(u) ** self.exponent)

    def step(self, before: float, stretch: float, rate: float, state: float, time_step: float) -> Step:
        """See `Nonlinear.step`: the force depends on the path only, in steps of fourth order."""
        path = stretch - before
        direction = 1.0 if path >= 0 else -1.0
        count = 1 + int(4 * self.stiffness * abs(path) / self.force)
        h, z = path / count, state
        for _ in range(count):
            a = self.slope(z, direction)
            b = self.slope(z + 0.5 * h * a, direction)
            c = self.slope(z + 0.5 * h * b, direction)
            z += h / 6 * (a + 2 * b + 2 * c + self.slope(z + h * c, direction))
        return z - self.stiffness * stretch, self.slope(z, direction) - self.stiffness, 0.0, z
