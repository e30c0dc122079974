"""Assemblies as the compiled march under forces takes them, and their derivatives by small differences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.assembly import Assembly
from ema_pipeline.mechanics.driven_system import CodedElements, DrivenSystem, Slopes


def driven_system(assembly: Assembly, in_rows: NDArray[np.float64]) -> DrivenSystem:
    """An assembly that forces drive along `in_rows`, (n_inputs, n)."""
    return CodedElements.of(assembly).driven(assembly.system(), in_rows)


def set_difference(slopes: Slopes, column: int, low: DrivenSystem, high: DrivenSystem, step: float) -> None:
    """Fill in the derivatives by one parameter from the systems `step` apart."""
    arrays = slopes.arrays[: len(low.varied)]
    for mine, a, b in zip(arrays, low.varied, high.varied, strict=True):
        mine[..., column] = (b - a) / step
