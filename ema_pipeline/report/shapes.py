"""Measured shapes with the model's beside them, and the drawing of the rig that they move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.assurance import real_shape
from ema_pipeline.report.results import ConfigurationResults
from ema_pipeline.rigs import drawing_of
from ema_pipeline.rigs.drawing import Drawing, Motion


def drawing_for(configuration: ConfigurationResults) -> Drawing | None:
    """The rig's drawing, by the model's DOFs or else by the measured ones; None where the rig has none."""
    if configuration.system is not None:
        return drawing_of(configuration.system.dofs, complete=True)
    if configuration.modal is not None:
        return drawing_of([d.point for d in configuration.modal.dofs], complete=False)
    return None


def missing_words(moved: Mapping[str, Motion]) -> str:
    """What is not measured, in a few words; bodies that lack the same are named together."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, motion in moved.items():
        if motion.missing:
            groups.setdefault(motion.missing, []).append(name)
    if not groups:
        return ""
    every = len(moved)
    parts = [
        f"{', '.join(lacks)} of {'all bodies' if len(names) == every else ', '.join(names)}"
        for lacks, names in groups.items()
    ]
    return "not measured: " + "; ".join(parts)


@dataclass(frozen=True)
class ShapePair:
    """A measured shape, turned to be as real as can be, and the model's beside it in the same scale.

    Both have a largest measured entry of about 1. `model` is None without a partner.
    """

    measured: dict[str, complex]
    std: dict[str, float]
    model: dict[str, complex] | None
    model_frequency_hz: float
    combined: bool


def shape_pair(configuration: ConfigurationResults, index: int) -> ShapePair:
    """Shapes of one measured mode and of its model mode, at DOF names without sign.

    In a close group any mixture of the group's shapes is a shape too: then the mixture that comes closest
    to the measured shape is shown.
    """
    modal = configuration.modal
    assert modal is not None
    mode = modal.modes[index]
    points = [d.point for d in modal.dofs]
    turned, _ = real_shape(mode.shape)
    peak = float(np.nanmax(np.abs(turned), initial=0.0)) or 1.0
    turned = turned / peak
    measured = dict(zip(points, (complex(v) for v in turned), strict=True))
    std = dict(zip(points, (float(s) / peak for s in mode.shape_std), strict=True))
    pairing, system = configuration.pairing, configuration.system
    pair = next((p for p in pairing.pairs if p.measured == index), None) if pairing else None
    if pair is None or pairing is None or system is None:
        return ShapePair(measured, std, None, float("nan"), False)
    group = [p.model for p in pairing.pairs if p.group >= 0 and p.group == pair.group] or [pair.model]
    rows = sensor_matrix(system, points)
    shapes = np.array([pairing.model_modes[j].shape for j in group])
    at_points = shapes @ rows.T
    common = np.isfinite(turned) & np.isfinite(at_points).all(axis=0)
    weights, *_ = np.linalg.lstsq(at_points[:, common].T, turned[common].real, rcond=None)
    combined = weights @ shapes
    everywhere = list(dict.fromkeys([*system.dofs, *system.sensors]))
    values = sensor_matrix(system, everywhere) @ combined
    model = dict(zip(everywhere, (complex(v) for v in values), strict=True))
    return ShapePair(measured, std, model, pair.model_frequency_hz, len(group) > 1)


def sensor_matrix(system: LinearSystem, points: Sequence[str]) -> NDArray[np.float64]:
    """Rows that turn the system's coordinates into what sensors at `points` read; NaN where it has none."""
    at = {d: i for i, d in enumerate(system.dofs)}
    rows = np.full((len(points), len(system.dofs)), np.nan)
    for r, point in enumerate(points):
        if point in at:
            rows[r] = 0.0
            rows[r, at[point]] = 1.0
        elif point in system.sensors:
            rows[r] = system.sensors[point]
    return rows


def body_of(point: str) -> str:
    """Body of a DOF written as text, with or without sign."""
    return Dof.parse(point).body
