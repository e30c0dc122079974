"""The measured modes of one configuration, prepared for residuals: weights, counts, sensor rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes, with_floors
from ema_pipeline.correlate.pairing import sensor_rows
from ema_pipeline.correlate.settings import UncertaintySettings
from ema_pipeline.mechanics.modes import normal_modes
from ema_pipeline.mechanics.system import LinearSystem

_ALONE = 2.0
"""Half-power half-widths to the next mode."""
_OVERLAPPING = 4.0
"""By how much the size is less certain where modes overlap."""
_DAMPING = 0.01
CALIBRATED = 0.2
"""Logarithm of a common factor beyond which sizes of shapes are not used."""
_ALIKE, _FEW = 0.9, 3


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
    log_size, size_weight : ndarray, (R,)
        Natural logarithm of what the shapes were divided by, and 1/std of it where shapes are mass-normalised; 0
        where not.
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
    log_size: NDArray[np.float64]
    size_weight: NDArray[np.float64]
    counts: NDArray[np.float64]

    @property
    def has_shapes(self) -> bool:
        return bool(np.any(self.shape_weight > 0))

    @property
    def shape_counts(self) -> NDArray[np.float64]:
        """Number of real data of each shape, its size left aside, (R,)."""
        return self.counts - 1.0 - (self.damping_weight > 0) - (self.size_weight > 0)

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
        log_size, size_weight = np.zeros(len(m)), np.zeros(len(m))
    else:
        valid = np.isfinite(m.shapes)
        shapes = np.where(valid, m.shapes, 0.0)
        size = np.maximum(np.max(np.abs(shapes), axis=1, keepdims=True), 1e-300)
        shapes = shapes / size
        weight = np.where(valid, size / np.where(valid, m.shape_std, 1.0), 0.0)
        # One complex scale factor is free; a table of real shapes carries no information on phase.
        parts = 1.0 if not np.any(shapes.imag) else 2.0
        shape_counts = parts * np.maximum(valid.sum(axis=1) - 1, 0)
        log_size = np.log(size[:, 0])
        factor = size_factor(m, system)
        trusted = m.scaled and bool(abs(np.log(factor)) < CALIBRATED)
        size_weight = _size_weight(m, settings, shapes, weight) if trusted else np.zeros(len(m))
    return Evidence(
        measured=m,
        rows=rows,
        omega=2 * np.pi * m.frequency_hz,
        relative_std=m.frequency_std_hz / m.frequency_hz,
        damping=damping,
        damping_weight=damping_weight,
        shapes=np.asarray(shapes, dtype=complex),
        shape_weight=weight,
        log_size=log_size,
        size_weight=size_weight,
        counts=1.0 + known + shape_counts + (size_weight > 0),
    )


def size_factor(m: MeasuredModes, system: LinearSystem) -> float:
    """Median of measured over modelled size of mass-normalised shapes that look alike; 1 where fewer than three do.

    Far from 1 a sensitivity is wrong, or the blows were not where they are said to be: a common factor is no physics
    of the rig.
    """
    if m.shapes is None or not m.dofs or not m.scaled:
        return 1.0
    _, phi = normal_modes(system)
    model = (sensor_rows(system, m) @ phi).T
    ratios = []
    for y in m.shapes:
        valid = np.isfinite(y)
        power = np.sum(np.abs(model[:, valid]) ** 2, axis=1)
        product = np.abs(model[:, valid] @ y[valid].conj())
        own = float(np.sum(np.abs(y[valid]) ** 2))
        alike = product**2 / np.maximum(power * own, 1e-300)
        best = int(np.argmax(alike))
        if alike[best] > _ALIKE:
            ratios.append(product[best] / power[best])
    return float(np.median(ratios)) if len(ratios) >= _FEW else 1.0


def _size_weight(
    m: MeasuredModes,
    settings: UncertaintySettings,
    shapes: NDArray[np.complex128],
    weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """1/std of the logarithm of the size of mass-normalised shapes; 0 where it is not known.

    Modes that overlap share their residues: what one of them has too much the other lacks. A mode whose points move out
    of phase has no one size: its modal mass is complex, and with gyroscopic forces its left shape is another one.
    """
    if settings.scale_floor <= 0:
        return np.zeros(len(m))
    known = np.where(weight > 0, weight, np.nan)
    scatter = np.array([1 / np.nanmedian(w) if np.any(w > 0) else np.inf for w in known])
    f = m.frequency_hz
    width = _ALONE * f * np.nan_to_num(m.damping_ratio, nan=_DAMPING)
    apart = np.abs(f[:, None] - f[None, :]) + np.where(np.eye(len(m), dtype=bool), np.inf, 0.0)
    overlaps = np.min(apart, axis=1, initial=np.inf) < width
    floor = np.where(overlaps, _OVERLAPPING * settings.scale_floor, settings.scale_floor)
    power = np.maximum(np.sum(np.abs(shapes) ** 2, axis=1), 1e-300)
    out_of_phase = 1 - np.abs(np.sum(shapes**2, axis=1)) / power
    return np.asarray(1 / np.sqrt(floor**2 + scatter**2 + out_of_phase**2))
