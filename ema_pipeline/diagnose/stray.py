"""Measured modes that are the rig's for sure and that a model does not have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ema_pipeline.diagnose.fitting import Case, Fitted
from ema_pipeline.mechanics.modes import normal_modes

_WELL_DETERMINED = 0.03
_STRONG = 0.03
"""Share of the rig's own modes' largest amplitude, mass-normalised."""


@dataclass(frozen=True)
class StrayMode:
    """A measured mode without counterpart.

    Attributes
    ----------
    configuration : str
    frequency_hz : float
    place : str
        DOF that it moves most.
    """

    configuration: str
    frequency_hz: float
    place: str


def strong_unexplained(case: Case, model: Fitted) -> list[StrayMode]:
    """Unexplained modes that move the rig about as its own modes do, and are not next to one of them.

    A mode of the foundation is hardly seen in mass-normalised shapes of the rig. Two modes closer than a half-width may
    have been measured as one: such a mode fits neither and is no sign of anything missing.
    """
    rig = case.rig_of(model.hypothesis)
    found, start = [], 0
    for c, m in case.measured.items():
        explained = model.explained[start : start + len(m)]
        start += len(m)
        if m.shapes is None or m.shape_std is None or not m.scaled or not np.any(explained):
            continue
        size = np.nanmax(np.abs(m.shapes), axis=1)
        least = _STRONG * float(np.median(size[explained]))
        known = {n: v for n, v in model.values.items() if n in rig.parameters}
        own, _ = normal_modes(rig.system(c, known))
        for r in np.flatnonzero(~explained & (size > least)):
            width = m.frequency_hz[r] * m.damping_ratio[r]
            clear = np.nanmedian(m.shape_std[r]) < _WELL_DETERMINED * size[r]
            if clear and np.min(np.abs(own - m.frequency_hz[r])) > width:
                place = m.dofs[int(np.nanargmax(np.abs(m.shapes[r])))].point
                found.append(StrayMode(c, float(m.frequency_hz[r]), place))
    return found


def solid_unexplained(case: Case, model: Fitted) -> list[str]:
    """Measured modes with well-determined shapes that a model does not explain."""
    found, start = [], 0
    for c, m in case.measured.items():
        left = ~model.explained[start : start + len(m)]
        start += len(m)
        for r in np.flatnonzero(left):
            if m.shapes is None or m.shape_std is None:
                found.append(f"{m.frequency_hz[r]:.1f} Hz ({c})")
                continue
            largest = float(np.nanmax(np.abs(m.shapes[r])))
            if (
                not np.any(np.isfinite(m.shape_std[r]))
                or np.nanmedian(m.shape_std[r]) < _WELL_DETERMINED * largest
            ):
                found.append(f"{m.frequency_hz[r]:.1f} Hz ({c})")
    return found
