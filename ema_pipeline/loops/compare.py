"""Measured loops beside those of a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.loops.types import Loop, LoopFit


def loop_fits(loops: Sequence[Loop], forces: Sequence[NDArray[np.float64]]) -> tuple[LoopFit, ...]:
    """Energies and misfits of a model's forces at the points of the loops; each takes the loop's offset."""
    return tuple(_fit(loop, force) for loop, force in zip(loops, forces, strict=True))


def _fit(loop: Loop, force: NDArray[np.float64]) -> LoopFit:
    model = force + float(np.mean(loop.force - force))
    energy = float(np.mean(model * loop.velocity)) / loop.frequency_hz
    difference = float(np.sqrt(np.mean((model - loop.force) ** 2)))
    return LoopFit(
        name=loop.name,
        force=model,
        energy_j=energy,
        energy_error=energy / loop.energy_j - 1 if loop.energy_j else float("nan"),
        misfit=difference / max(0.5 * float(np.ptp(loop.force)), 1e-300),
    )
