"""Where model and measurement part: by mode, DOF and band, in units of the uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.evidence import Evidence, gather
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.residuals import Modes, matrices, mode_residuals, observable_modes
from ema_pipeline.correlate.settings import CompareSettings
from ema_pipeline.correlate.types import BandDifference, Comparison, DofDifference, ModeDifference, Pairing
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.rigs.types import Rig


def compare(
    rig: Rig,
    values: Mapping[str, float] | None,
    measured: Mapping[str, MeasuredModes],
    frfs: Mapping[str, FrfSet] | None,
    pairings: Mapping[str, Pairing],
    settings: CompareSettings | None = None,
) -> Comparison:
    """Compare a rig at parameter `values` with what was measured.

    Parameters
    ----------
    rig : Rig
    values : mapping of parameter to value, optional
        Nominal where left out.
    measured : mapping of configuration to MeasuredModes
    frfs : mapping of configuration to FrfSet, optional
        Compared by band where given.
    pairings : mapping of configuration to Pairing
        Made at the same `values`.
    settings : CompareSettings, optional

    Returns
    -------
    Comparison
        Errors are measurement minus model over the standard uncertainty (the test's scatter and the floors of
        `settings`, root sum of squares). Modes without a partner take no part; the pairing lists them.
    """
    settings = settings or CompareSettings()
    modes: list[ModeDifference] = []
    dofs: list[DofDifference] = []
    bands: list[BandDifference] = []
    squares, count, epsilon = 0.0, 0.0, 0.0
    for configuration, pairing in pairings.items():
        if configuration not in measured or not len(measured[configuration]):
            continue
        system = rig.system(configuration, values)
        evidence = gather(measured[configuration], system, settings)
        model = observable_modes(matrices(system))
        pairs = _pairs(pairing, len(evidence.measured))
        residual = mode_residuals(evidence, pairs, model, settings.mode_mixing)[0]
        squares += float(np.sum(residual**2))
        count += float(np.sum(evidence.counts[pairs >= 0]))
        modes += _mode_differences(evidence, pairing, model, residual)
        dofs += _dof_differences(evidence, pairs, residual)
        epsilon += sum(
            ((p.measured_frequency_hz - p.model_frequency_hz) / p.model_frequency_hz) ** 2
            for p in pairing.pairs
        )
        if frfs is not None and configuration in frfs:
            bands += band_differences(configuration, system, frfs[configuration], settings)
    return Comparison(
        error=float(np.sqrt(squares / count)) if count else float("nan"),
        frequency_error=float(epsilon),
        modes=tuple(modes),
        dofs=tuple(dofs),
        bands=tuple(bands),
    )


def band_differences(
    configuration: str, system: LinearSystem, frfs: FrfSet, settings: CompareSettings
) -> list[BandDifference]:
    """Root-mean-square difference of every FRF from the model's, in bands of equal logarithmic width.

    An FRF in volts has no scale of its own: one common factor is fitted to each input first.
    """
    low, high = frfs.band_hz
    f = frfs.frequency_hz
    low = max(low, float(f[1]) if f.size > 1 else low)
    edges = np.geomspace(low, max(high, low * 1.01), settings.bands + 1)
    lines, number = _lines(f, edges, settings.lines_per_band)
    if lines.size == 0:
        return []
    picked = replace(
        frfs,
        frequency_hz=f[lines],
        frf=frfs.frf[..., lines],
        coherence=frfs.coherence[..., lines],
        variance=frfs.variance[..., lines],
    )
    measured = picked.accelerance()
    factor = np.abs(measured) ** 2 / np.maximum(np.abs(picked.frf) ** 2, 1e-300)
    variance = np.nan_to_num(picked.variance) * factor
    model = windowed_accelerance(system, picked)
    if not frfs.force_calibrated:
        scale = np.nansum(np.abs(measured * model.conj()), axis=(0, 2)) / np.maximum(
            np.sum(np.abs(model) ** 2 * np.isfinite(measured), axis=(0, 2)), 1e-300
        )
        model = model * scale[None, :, None]
    out = []
    for b in range(settings.bands):
        inside = number == b
        if not np.any(inside):
            continue
        h, difference = measured[..., inside], measured[..., inside] - model[..., inside]
        size = np.abs(h) ** 2
        known = np.isfinite(size)
        level = np.sum(np.where(known, size, 0.0), axis=(0, 2), keepdims=True) / np.maximum(
            np.sum(known, axis=(0, 2), keepdims=True), 1
        )
        # the scatter of two or three hits is itself too uncertain to be used line by line
        scatter = np.mean(variance[..., inside], axis=2, keepdims=True)
        sigma2 = scatter + settings.frf_floor**2 * size + settings.frf_background**2 * level
        z = np.sqrt(np.mean(np.abs(difference) ** 2 / np.maximum(sigma2, 1e-300), axis=2))
        for o, i in zip(*np.nonzero(np.isfinite(z)), strict=True):
            out.append(
                BandDifference(
                    configuration=configuration,
                    output=frfs.outputs[o].point,
                    input=frfs.inputs[i].point,
                    low_hz=float(edges[b]),
                    high_hz=float(edges[b + 1]),
                    z=float(z[o, i]),
                )
            )
    return out


def windowed_accelerance(system: LinearSystem, frfs: FrfSet) -> NDArray[np.complex128]:
    """Accelerance as a test with an exponential window sees it: at jω + σ in place of jω."""
    sigma = frfs.response_decay_rad_s
    if sigma > 0:
        damping = total_damping(system)
        system = replace(
            system,
            stiffness=system.stiffness + sigma * 0.5 * (damping + damping.T) + sigma**2 * system.mass,
            damping=damping + 2 * sigma * system.mass,
            modal_damping_ratio=0.0,
        )
    s = sigma + 2j * np.pi * frfs.frequency_hz
    rows_out, rows_in = sensor_rows(system, frfs.outputs), sensor_rows(system, frfs.inputs)
    return np.asarray(s**2 * receptance(system, frfs.frequency_hz, rows_out, rows_in))


def _lines(
    frequency_hz: NDArray[np.float64], edges: NDArray[np.float64], most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Evenly picked lines of every band, and the number of the band of each."""
    lines, number = [], []
    for b in range(edges.size - 1):
        inside = np.flatnonzero(
            (frequency_hz >= edges[b]) & (frequency_hz < edges[b + 1]) & (frequency_hz > 0)
        )
        if inside.size > most:
            inside = inside[np.linspace(0, inside.size - 1, most).round().astype(int)]
        lines.append(inside)
        number.append(np.full(inside.size, b))
    return np.concatenate(lines).astype(np.int64), np.concatenate(number).astype(np.int64)


def _pairs(pairing: Pairing, count: int) -> NDArray[np.int64]:
    pairs = np.full(count, -1, dtype=np.int64)
    for p in pairing.pairs:
        pairs[p.measured] = p.model
    return pairs


def _mode_differences(
    e: Evidence, pairing: Pairing, model: Modes, residual: NDArray[np.float64]
) -> list[ModeDifference]:
    m = e.measured
    out = []
    for p in pairing.pairs:
        r, k = p.measured, p.model
        shape_data = e.shape_counts[r]
        out.append(
            ModeDifference(
                configuration=m.configuration,
                measured=r,
                family=p.family,
                measured_frequency_hz=float(m.frequency_hz[r]),
                frequency_std_hz=float(m.frequency_std_hz[r]),
                model_frequency_hz=float(model.omega[0, k] / (2 * np.pi)),
                # the residual is model minus measurement
                frequency_z=float(-residual[r, 0]),
                measured_damping_ratio=float(m.damping_ratio[r]),
                damping_std=float(m.damping_std[r]),
                model_damping_ratio=float(model.damping_ratio[0, k]),
                damping_z=float(-residual[r, 1]) if e.damping_weight[r] > 0 else float("nan"),
                mac=p.mac,
                shape_z=float(np.sqrt(np.sum(residual[r, 2:-1] ** 2) / shape_data))
                if shape_data > 0
                else float("nan"),
            )
        )
    return out


def _dof_differences(
    e: Evidence, pairs: NDArray[np.int64], residual: NDArray[np.float64]
) -> list[DofDifference]:
    n = len(e.measured.dofs)
    has = pairs >= 0
    if not e.has_shapes or not np.any(has):
        return []
    power = residual[has][:, 2 : 2 + n] ** 2 + residual[has][:, 2 + n : 2 + 2 * n] ** 2
    parts = 2.0 if np.any(e.shapes.imag) else 1.0
    used = np.sum(e.shape_weight[has] > 0, axis=0)
    z = np.sqrt(np.sum(power, axis=0) / np.maximum(parts * used, 1.0))
    return [
        DofDifference(e.measured.configuration, dof.point, float(z[i]))
        for i, dof in enumerate(e.measured.dofs)
        if used[i] > 0
    ]
