"""Where model and measurement differ: by mode, DOF and band, in units of the uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.settings import CompareSettings
from ema_pipeline.correlate.types import (
    BandDifference,
    Comparison,
    DofDifference,
    ModeAlone,
    ModeDifference,
    Pairing,
)
from ema_pipeline.fit.parameters import FittedModes
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.mechanics.frf import receptance
from ema_pipeline.mechanics.modes import total_damping
from ema_pipeline.mechanics.system import LinearSystem, sensor_rows
from ema_pipeline.observations.mode_problem import ModeRows


def compare(
    fitted: FittedModes,
    measured: Mapping[str, MeasuredModes],
    frfs: Mapping[str, FrfSet] | None,
    pairings: Mapping[str, Pairing],
    settings: CompareSettings | None = None,
) -> Comparison:
    """Compare a fitted model with what was measured.

    Parameters
    ----------
    fitted : FittedModes
    measured : mapping of configuration to MeasuredModes
    frfs : mapping of configuration to FrfSet, optional
        Compared by band where given.
    pairings : mapping of configuration to Pairing
        Of the same fitted model.
    settings : CompareSettings, optional

    Returns
    -------
    Comparison
        Differences are measurement minus model over the standard uncertainty, which holds the test's own scatter and
        what was learned of damping and of the model itself; `error` is the fit's. Modes without a partner are `alone`.
    """
    settings = settings or CompareSettings()
    rows = fitted.problem.rows(fitted.posterior.residuals)
    bands: list[BandDifference] = []
    for configuration in pairings:
        if frfs is not None and configuration in frfs:
            system = fitted.system(configuration)
            bands += band_differences(configuration, system, frfs[configuration], settings)
    return Comparison(
        error=fitted.posterior.error,
        frequency_error=sum(
            ((p.measured_frequency_hz - p.model_frequency_hz) / p.model_frequency_hz) ** 2
            for pairing in pairings.values()
            for p in pairing.pairs
        ),
        modes=tuple(d for r in rows if (d := _mode_difference(fitted, r, measured, pairings)) is not None),
        dofs=tuple(_dof_differences(fitted, rows)),
        bands=tuple(bands),
        alone=tuple(_alone(fitted, measured, pairings)),
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


def _mode_difference(
    fitted: FittedModes,
    row: ModeRows,
    measured: Mapping[str, MeasuredModes],
    pairings: Mapping[str, Pairing],
) -> ModeDifference | None:
    m = measured[row.configuration]
    pairing = pairings[row.configuration]
    model = fitted.problem.solution(row.configuration, fitted.posterior.x)
    frequency_hz = float(model.frequency_hz[row.model])
    # Where a mode is damped so far that it does not vibrate, the pairing has fewer of them.
    listed = int(np.argmin([abs(mode.frequency_hz - frequency_hz) for mode in pairing.model_modes]))
    pair = next((p for p in pairing.pairs if p.measured == row.measured), None)
    mac = pair.mac if pair is not None else float(np.nan_to_num(pairing.mac[row.measured, listed]))
    shape = row.shape[np.isfinite(row.shape)]
    return ModeDifference(
        configuration=row.configuration,
        measured=row.measured,
        family=pairing.model_modes[listed].family,
        measured_frequency_hz=float(m.frequency_hz[row.measured]),
        frequency_std_hz=float(m.frequency_std_hz[row.measured]),
        model_frequency_hz=frequency_hz,
        frequency_z=row.frequency,
        measured_damping_ratio=float(m.damping_ratio[row.measured]),
        damping_std=float(m.damping_std[row.measured]),
        model_damping_ratio=float(model.damping_ratio[row.model]),
        damping_z=row.damping,
        mac=mac,
        shape_z=float(np.sqrt(np.mean(shape**2))) if len(shape) else float("nan"),
    )


def _alone(
    fitted: FittedModes, measured: Mapping[str, MeasuredModes], pairings: Mapping[str, Pairing]
) -> list[ModeAlone]:
    """Measured modes that the fit gave no partner; one of the same shape may be far off in frequency."""
    matching, found = fitted.posterior.residuals.matching, list[ModeAlone]()
    assert isinstance(matching, tuple)
    for data, match in zip(fitted.observations.data, matching, strict=True):
        name = data.configuration
        for k in np.flatnonzero(match < 0).tolist():
            pair = next((p for p in pairings[name].pairs if p.measured == k), None)
            hz, mac = (np.nan, np.nan) if pair is None else (pair.model_frequency_hz, pair.mac)
            found.append(ModeAlone(name, k, float(measured[name].frequency_hz[k]), hz, mac))
    return found


def _dof_differences(fitted: FittedModes, rows: Sequence[ModeRows]) -> list[DofDifference]:
    """Root mean square over all modes of what each sensor is off."""
    found = []
    for data in fitted.observations.data:
        here = [r.shape for r in rows if r.configuration == data.configuration]
        if not here or not data.dofs:
            continue
        z = np.array(here)
        for i, dof in enumerate(data.dofs):
            seen = z[np.isfinite(z[:, i]), i]
            if len(seen):
                found.append(DofDifference(data.configuration, dof.point, float(np.sqrt(np.mean(seen**2)))))
    return found
