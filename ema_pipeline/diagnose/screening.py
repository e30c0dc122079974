"""Screening of the data before any hypothesis is tried."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.evidence import CALIBRATED, size_factor
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.heldout import subset
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.rigs.types import Rig

_REACH = 1.3


@dataclass(frozen=True)
class Screening:
    """What the data can be used for.

    Attributes
    ----------
    measured : dict of str to MeasuredModes
        Without empty configurations and without modes beyond the model's reach.
    notes : tuple of str
    too_few : str
        Why no diagnosis can be made; empty where it can.
    """

    measured: dict[str, MeasuredModes]
    notes: tuple[str, ...]
    too_few: str


def screen(rig: Rig, measured: Mapping[str, MeasuredModes]) -> Screening:
    """Leave out what no lumped model of this size could explain, and say so.

    Parameters
    ----------
    rig : Rig
    measured : mapping of configuration to MeasuredModes
    """
    kept: dict[str, MeasuredModes] = {}
    notes: list[str] = []
    modes, shapes = 0, False
    for c, m in measured.items():
        if not len(m) or c not in rig.configurations:
            kept[c] = m
            continue
        highest = max(float(normal_modes(rig.system(c))[0].max()) * _reach(rig, c), 1.0)
        inside = m.frequency_hz <= highest
        if not np.all(inside):
            which = ", ".join(f"{f:.0f}" for f in m.frequency_hz[~inside])
            notes.append(f"{c}: beyond the model's reach and left out: {which} Hz")
        blurred = inside & _not_separated(m)
        if np.any(blurred):
            which = ", ".join(f"{f:.1f}" for f in m.frequency_hz[blurred])
            notes.append(f"{c}: not told apart from a neighbour and left out: {which} Hz")
            inside &= ~blurred
        kept[c] = subset(m, inside)
        modes += int(np.sum(inside))
        shapes |= m.shapes is not None and bool(m.dofs)
        if not np.any(np.isfinite(m.frequency_std_hz) & (m.frequency_std_hz > 0)):
            notes.append(f"{c}: no standard deviations of the frequencies are stated, so they are assumed")
        factor = size_factor(m, rig.system(c))
        if abs(np.log(factor)) > CALIBRATED:
            notes.append(
                f"{c}: mass-normalised shapes are {factor:.2f} times as large as the model's, so their sizes are not "
                "used; check the sensitivities of hammer and accelerometers"
            )
        if m.shapes is not None and len(m.references) == 1:
            notes.append(f"{c}: struck at one point only; of two equal modes one may be hidden")
    kept = {c: m for c, m in kept.items() if len(m)} or kept
    free = sum(
        p.free
        for n, p in rig.parameters.items()
        if any(n in rig.used(c) for c in kept if c in rig.configurations)
    )
    too_few = ""
    if modes <= free + 1:
        too_few = (
            f"{modes} measured modes cannot determine {free} free parameters and show an effect besides."
        )
    elif not shapes:
        notes.append("frequencies only: effects that shapes would tell apart may look alike")
    return Screening(kept, tuple(notes), too_few)


def _not_separated(m: MeasuredModes) -> NDArray[np.bool_]:
    """Modes within a half-width of another one whose shapes are known to no better than their own size."""
    if m.shapes is None or m.shape_std is None or not m.dofs or len(m) < 2:
        return np.zeros(len(m), dtype=bool)
    with np.errstate(invalid="ignore"):
        size = np.nanmax(np.abs(m.shapes), axis=1)
        unknown = np.nanmedian(m.shape_std, axis=1) > size
    apart = np.abs(m.frequency_hz[:, None] - m.frequency_hz[None, :])
    np.fill_diagonal(apart, np.inf)
    return np.asarray(unknown & (np.min(apart, axis=1) < m.frequency_hz * np.nan_to_num(m.damping_ratio)))


def _reach(rig: Rig, configuration: str) -> float:
    """How far free parameters may lift the model's highest mode."""
    stretch = _REACH
    for name in rig.used(configuration):
        p = rig.parameters[name]
        if p.free and p.value > 0 and np.isfinite(p.maximum):
            stretch = max(stretch, _REACH * float(np.sqrt(p.maximum / p.value)))
    return stretch
