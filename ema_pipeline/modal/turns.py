"""What the directions of the hits do to shapes that sensors measure in turn.

Hits are some degrees off, so that they act a little across the direction that is stated: A_oi = φ_o·(φ_i + θ·φ_⊥), with
the shape φ at the sensor o, at the point of impact i, and there across the blow. Sensors that are read together share
that factor, which changes the scale of a shape, and not its form. Sensors that are moved are read in turns, and every
turn has hits with a θ of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.frf.channels import OFF_DIRECTION, moved_sensors
from ema_pipeline.frf.types import FrfSet

AXES = {"x", "y", "z"}
OF_ONE_HIT = np.sqrt(2) * OFF_DIRECTION
"""1 σ, in rad, of the direction of one hit."""


def spread_of_turns(frfs: FrfSet, dofs: Sequence[Dof], shapes: NDArray[np.complex128]) -> NDArray[np.float64]:
    """1 σ of shape entries by the directions of the hits of every turn; 0 at sensors that stay.

    Parameters
    ----------
    frfs : FrfSet
    dofs : sequence of Dof
        Of the shapes. Across points of impact without a sensor nothing is known, and nothing is added.
    shapes : complex ndarray, (n_modes, n_dofs)

    Returns
    -------
    ndarray, (n_modes, n_dofs)
    """
    place = {dof.point: k for k, dof in enumerate(dofs)}
    moved = moved_sensors(frfs)
    power = np.nan_to_num(np.abs(shapes) ** 2)
    spread = np.zeros(shapes.shape)
    struck = [k for k, dof in enumerate(frfs.inputs) if dof.direction in AXES and dof.point in place]
    if not moved or frfs.excitation or not struck:
        return spread
    along = power[:, [place[frfs.inputs[k].point] for k in struck]]
    across = np.stack([_across(frfs.inputs[k], place, power) for k in struck], axis=1)
    total = np.sum(along, axis=1)
    for output, channel, hits in zip(frfs.outputs, frfs.channels, frfs.hits[:, struck], strict=True):
        if output.point not in place or not moved & set(channel.sensors):
            continue
        # hits on all points tell of the entry, by the square of the shape there
        variance = OF_ONE_HIT**2 * np.sum(along * across / np.maximum(hits, 1), axis=1)
        relative = np.sqrt(variance) / np.where(total > 0, total, np.inf)
        spread[:, place[output.point]] = relative * np.abs(np.nan_to_num(shapes[:, place[output.point]]))
    return spread


def _across(impact: Dof, place: dict[str, int], power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squares of shapes across a blow, at the same body, (n_modes,)."""
    others = [place[p] for d in AXES - {impact.direction} if (p := f"{impact.body}.{d}") in place]
    return np.asarray(np.sum(power[:, others], axis=1))
