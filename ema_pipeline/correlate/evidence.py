"""The measured modes of one configuration, prepared for residuals: weights, counts, sensor rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes, with_floors
from ema_pipeline.correlate.pairing import sensor_rows
from ema_pipeline.correlate.settings import UncertaintySettings
from ema_pipeline.mechanics.system import LinearSystem


@dataclass(frozen=True)
class Evidence:
    """One configuration's modes with standard uncertainties, shapes scaled to a largest entry of 1.

    Attributes
    ----------
    measured : MeasuredModes
        With floors.
    rows : ndarray, (n_dofs, n)
    omega : ndarray, (R,)
        rad/s.
    relative_std : ndarray, (R,)
        Of the frequency.
    damping, damping_weight : ndarray, (R,)
        Damping ratio and 1/std; 0 where not used.
    shapes : complex ndarray, (R, n_dofs)
        0 where not measured.
    shape_weight : ndarray, (R, n_dofs)
        1/std; 0 where not measured.
    counts : ndarray, (R,)
        Number of real data of each mode, one scale factor per shape taken off.
    """

    measured: MeasuredModes
    rows: NDArray[np.float64]
    omega: NDArray[np.float64]
    relative_std: NDArray[np.float64]
    damping: NDArray[np.float64]
    damping_weight: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    shape_weight: NDArray[np.float64]
    counts: NDArray[np.float64]

    @property
    def has_shapes(self) -> bool:
        return bool(np.any(self.shape_weight > 0))

    def outlier_cost(self, scale: float) -> NDArray[np.float64]:
        """-2 log likelihood of a mode of any shape anywhere in the band, relative to a perfect fit, (R,).

        `scale` multiplies all standard uncertainties.
        """
        band = self.measured.band_hz
        f = self.measured.frequency_hz
        width = max(band[1] - band[0], 1e-9) if band is not None else max(float(f.max()), 1e-9)
        anywhere = width / (scale * self.relative_std * f * np.sqrt(2 * np.pi))
        power = np.sum(np.abs(self.shapes) ** 2, axis=1)
        size = np.sqrt(power / np.maximum(np.sum(self.shape_weight > 0, axis=1), 1))
        any_shape = np.where(self.shape_weight > 0, size[:, None] * self.shape_weight / scale, 1.0)
        bits = np.sum(np.log(np.maximum(any_shape, 1.0)), axis=1) + np.log(np.maximum(anywhere, 1.0))
        return np.asarray(self.counts + 2 * bits)


def gather(measured: MeasuredModes, system: LinearSystem, settings: UncertaintySettings) -> Evidence:
    """Prepare one configuration's measured modes."""
    m = with_floors(measured, settings)
    rows = sensor_rows(system, m)
    damping = np.nan_to_num(m.damping_ratio)
    known = np.isfinite(m.damping_ratio) & (m.damping_ratio > 0)
    damping_weight = np.where(known, 1 / np.where(known, m.damping_std, 1.0), 0.0)
    if m.shapes is None or m.shape_std is None or not m.dofs:
        shapes = np.zeros((len(m), 0), dtype=complex)
        weight = np.zeros((len(m), 0))
        shape_counts = np.zeros(len(m))
    else:
        valid = np.isfinite(m.shapes)
        shapes = np.where(valid, m.shapes, 0.0)
        size = np.maximum(np.max(np.abs(shapes), axis=1, keepdims=True), 1e-300)
        shapes = shapes / size
        weight = np.where(valid, size / np.where(valid, m.shape_std, 1.0), 0.0)
        # One complex scale factor is free; a table of real shapes carries no information on phase.
        parts = 1.0 if not np.any(shapes.imag) else 2.0
        shape_counts = parts * np.maximum(valid.sum(axis=1) - 1, 0)
    return Evidence(
        measured=m,
        rows=rows,
        omega=2 * np.pi * m.frequency_hz,
        relative_std=m.frequency_std_hz / m.frequency_hz,
        damping=damping,
        damping_weight=damping_weight,
        shapes=np.asarray(shapes, dtype=complex),
        shape_weight=weight,
        counts=1.0 + known + shape_counts,
    )
