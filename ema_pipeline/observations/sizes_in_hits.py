"""Sizes to expect of nonlinear springs, from how far the hardest blows move the rig.

A coefficient of the square or the cube of a stretch means nothing without that stretch: 1e13 N/m³ is a tenth of a soft
frame's stiffness and nothing to a stiff bearing. Friction and gaps are what they are in newtons and metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ema_pipeline.dof import Dof
from ema_pipeline.effects.base import Effect, PlacedEffect
from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.marching import element_rows
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import sensor_row
from ema_pipeline.observations.hit_data import HitData
from ema_pipeline.observations.typical import SIZE_SHARE, Typical

_UNITS = ("N/m²", "N/m³")
_BEYOND = 1.3
"""Distance, as a ratio, from the lowest and highest measured mode to which modes of the model count."""


def sized_by_hits(library: Mapping[str, Effect], hits: Sequence[HitData]) -> Mapping[str, Effect]:
    """The library, its nonlinear springs with the sizes to expect where these hits struck.

    Prior 1 σ is the size whose force is half the restoring force, as the effect's mode is moved furthest by the hardest
    blow. Effects keep their own where forces are not known, or where no mode strains them.
    """
    if not hits or any(h.pulses is None for h in hits):
        return library
    blows = _Blows(hits)
    return {name: blows.sized(effect) for name, effect in library.items()}


class _Blows:
    """Largest impulse at every DOF that was struck, and the band in which modes were measured."""

    def __init__(self, hits: Sequence[HitData]) -> None:
        self.impulse: dict[Dof, float] = {}
        for h in hits:
            assert h.pulses is not None
            momentum = np.abs(h.pulses.force_n.sum(axis=1)) / h.pulses.sample_rate_hz
            for dof, one in zip(h.pulses.struck, momentum.tolist(), strict=True):
                self.impulse[dof] = max(one, self.impulse.get(dof, 0.0))
        self.low = min(float(h.omega.min()) for h in hits) / _BEYOND
        self.high = max(float(h.omega.max()) for h in hits) * _BEYOND

    def sized(self, effect: Effect) -> Effect:
        """The effect with its prior 1 σ where it is a nonlinear spring."""
        if effect.linear or not any(p.unit in _UNITS for p in effect.parameters):
            return effect

        def scales(assembly: Assembly, place: str) -> Mapping[str, float]:
            typical = self._typical(PlacedEffect(effect, place), assembly)
            found = {p.name: typical.size(p.unit) for p in effect.parameters if typical and p.unit in _UNITS}
            known = {name: SIZE_SHARE * size for name, size in found.items() if size is not None}
            return {**effect.scales(assembly, place), **known}

        return replace(effect, scales=scales)

    def _typical(self, placed: PlacedEffect, assembly: Assembly) -> Typical | None:
        """Motion and restoring force of the mode that the hardest blow moves furthest along the effect's elements."""
        added = placed.nonlinear_of(assembly)
        if not added:
            return None
        system = assembly.system()
        frequency_hz, shapes = normal_modes(system)
        omega = 2 * np.pi * frequency_hz
        inside = (omega > self.low) & (omega < self.high)
        omega, shapes = omega[inside], shapes[:, inside]
        struck = np.array(
            [
                impulse * sensor_row(system, dof) @ shapes
                for dof, impulse in self.impulse.items()
                if assembly.has_dof(dof.point)
            ]
        )
        stretch = np.abs(element_rows(assembly, added) @ shapes)
        if not struck.size or not np.any(stretch):
            return None
        moved = stretch * np.abs(struck).max(axis=0) / omega
        # what a cubic spring of unit size adds to the square of each mode's frequency, as a share of it
        share = (moved * stretch / omega) ** 2
        element, mode = np.unravel_index(np.argmax(share), share.shape)
        if not share[element, mode]:
            return None
        x = float(moved[element, mode])
        modal_stiffness = float((omega[mode] / stretch[element, mode]) ** 2)
        return Typical(x, float(omega[mode]), modal_stiffness * x)
