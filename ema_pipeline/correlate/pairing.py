"""Which measured mode is which model mode: one optimal assignment, and a reason for every refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.correlate.settings import PairingSettings
from ema_pipeline.correlate.types import Pair, Pairing, Unpaired
from ema_pipeline.mechanics.system import LinearSystem, sensor_row
from ema_pipeline.modal.assurance import mac, subspace_mac
from ema_pipeline.rigs.base import modes_of
from ema_pipeline.rigs.types import ModelMode, Rig

# Modes below this are rigid-body modes to any hammer test.
RIGID_HZ = 1e-3
_FORBIDDEN = 1e6


def pair_system(
    rig: Rig, system: LinearSystem, measured: MeasuredModes, settings: PairingSettings
) -> Pairing:
    """Pair measured modes with those of a system of the rig; see `pair`."""
    return pair(measured, modes_of(rig, system), system, settings)


def pair(
    measured: MeasuredModes,
    modes: Sequence[ModelMode],
    system: LinearSystem,
    settings: PairingSettings,
) -> Pairing:
    """Assign measured modes to model modes.

    The cost of a pair is (|ln f/f_model| / tolerance)² + (1 - MAC)/(1 - least MAC); the assignment of least
    total cost over all modes is taken (Hungarian method), in which a mode may also stay alone at the price
    of `settings.refusal`. Inside a group of close model modes the MAC is that of the measured shape with the
    span of the group's shapes, because single shapes are arbitrary there. The order of modes only breaks
    ties.

    Parameters
    ----------
    measured : MeasuredModes
        With shapes, or frequencies only; then the cost is that of the frequency alone.
    modes : sequence of ModelMode
        All modes of the model.
    system : LinearSystem
        The system that `modes` belong to; turns its coordinates into sensor readings.
    settings : PairingSettings

    References
    ----------
    Kuhn, H. W., "The Hungarian method for the assignment problem", Naval Research Logistics 2, 1955.
    """
    model_f = np.array([m.frequency_hz for m in modes])
    rows = sensor_rows(system, measured)
    full = np.array([_shape(m) for m in modes], dtype=complex).reshape(len(modes), -1)
    shapes = np.asarray(full @ rows.T, dtype=complex)
    groups = close_groups(model_f, settings.group_width)
    single, grouped = shape_agreement(measured, shapes, groups)
    elastic = model_f > RIGID_HZ
    ratio = np.maximum(measured.frequency_hz[:, None] / np.where(elastic, model_f, 1.0), 1e-12)
    distance = np.where(elastic, np.abs(np.log(ratio)), np.inf)
    chosen = assign(distance, grouped, single, settings)

    taken = {k: r for r, k in chosen.items()}
    pairs = tuple(
        Pair(
            measured=r,
            model=k,
            measured_frequency_hz=float(measured.frequency_hz[r]),
            model_frequency_hz=float(model_f[k]),
            mac=float(grouped[r, k]),
            family=modes[k].family,
            group=int(groups[k]) if int(np.sum(groups == groups[k])) > 1 else -1,
        )
        for r, k in sorted(chosen.items())
    )
    unpaired_measured = tuple(
        Unpaired(r, float(f), _why_measured(r, measured, model_f, distance, grouped, taken, settings))
        for r, f in enumerate(measured.frequency_hz)
        if r not in chosen
    )
    unpaired_model = tuple(
        Unpaired(
            k, float(f), _why_model(k, measured, modes, shapes, system, distance, grouped, taken, settings)
        )
        for k, f in enumerate(model_f)
        if k not in taken
    )
    return Pairing(tuple(modes), pairs, unpaired_measured, unpaired_model, single)


def sensor_rows(system: LinearSystem, measured: MeasuredModes) -> NDArray[np.float64]:
    """Rows that turn the system's coordinates into what the measured DOFs read, (n_dofs, n)."""
    if not measured.dofs:
        return np.zeros((0, len(system.dofs)))
    return np.array([sensor_row(system, d) for d in measured.dofs])


def close_groups(frequency_hz: NDArray[np.float64], width: float) -> NDArray[np.int64]:
    """Number of the group of each mode, (n,): neighbours closer than `width` (relative) share one."""
    order = np.argsort(frequency_hz, kind="stable")
    f = frequency_hz[order]
    apart = np.diff(f) > width * np.maximum(f[1:], RIGID_HZ)
    numbers = np.concatenate([[0], np.cumsum(apart)]) if f.size else np.zeros(0)
    groups = np.empty(f.size, dtype=np.int64)
    groups[order] = numbers
    return groups


def shape_agreement(
    measured: MeasuredModes, shapes: NDArray[np.complex128], groups: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """MAC of every measured with every model shape, and with the span of the model mode's group.

    Both (n_measured, n_model); NaN where no shapes were measured. None agrees with one that no sensor reads.
    """
    size = (len(measured), len(shapes))
    if measured.shapes is None or not measured.dofs:
        return np.full(size, np.nan), np.full(size, np.nan)
    single = mac(measured.shapes, shapes)
    grouped = single.copy()
    finite = np.isfinite(measured.shapes)
    for g in np.flatnonzero(np.bincount(groups) > 1):
        members = np.flatnonzero(groups == g)
        # A span of as many shapes as there are sensors holds everything: no comparison at all.
        compared = np.flatnonzero(finite.sum(axis=1) > members.size)
        if np.all(finite[compared]):
            share = _shares_inside(measured.shapes[compared], shapes[members])
        else:
            share = np.array([subspace_mac(measured.shapes[r], shapes[members]) for r in compared])
        grouped[np.ix_(compared, members)] = share.reshape(-1, 1)
    return single, np.where(np.isnan(single) & np.isfinite(single).any(axis=1, keepdims=True), 0.0, grouped)


def _shares_inside(shapes: NDArray[np.complex128], span: NDArray[np.complex128]) -> NDArray[np.float64]:
    """`subspace_mac` of several complete shapes with one span, (R,)."""
    size = np.linalg.norm(span, axis=1, keepdims=True)
    u, s, _ = np.linalg.svd((span / np.where(size > 0, size, 1.0)).T, full_matrices=False)
    basis = u[:, s > s[0] * max(span.shape) * np.finfo(float).eps]
    inside = np.sum(np.abs(shapes @ basis.conj()) ** 2, axis=1)
    return np.asarray(np.minimum(inside / np.sum(np.abs(shapes) ** 2, axis=1), 1.0))


def assign(
    distance: NDArray[np.float64],
    agreement: NDArray[np.float64],
    single: NDArray[np.float64],
    settings: PairingSettings,
) -> dict[int, int]:
    """Model mode of each measured mode, by least total cost.

    Parameters
    ----------
    distance : ndarray, (n_measured, n_model)
        |ln f_measured/f_model|.
    agreement, single : ndarray, (n_measured, n_model)
        MAC (in groups: subspace MAC) and plain MAC; NaN where unknown.
    """
    n_measured, n_model = distance.shape
    if not n_measured or not n_model:
        return {}
    with_shape = np.isfinite(agreement)
    unlike = np.where(with_shape, (1 - np.nan_to_num(agreement)) / (1 - settings.least_mac), 0.0)
    cost = (distance / settings.frequency_tolerance) ** 2 + unlike
    # Inside a group the plain MAC may still tell modes apart that are near but not equal.
    cost = cost + 0.02 * np.where(with_shape, np.nan_to_num(agreement) - np.nan_to_num(single), 0.0)
    ranks = np.abs(np.arange(n_measured)[:, None] / n_measured - np.arange(n_model)[None, :] / n_model)
    cost = cost + 1e-6 * ranks
    cost[(distance > settings.frequency_tolerance) | (unlike > 1.0)] = _FORBIDDEN
    alone = np.full((n_measured, n_measured), settings.refusal)
    rows, columns = linear_sum_assignment(np.hstack([cost, alone]))
    return {
        int(r): int(k)
        for r, k in zip(rows, columns, strict=True)
        if k < n_model and cost[r, k] < settings.refusal
    }


def _shape(mode: ModelMode) -> NDArray[np.complex128]:
    complex_shape = getattr(mode, "complex_shape", None)
    return np.asarray(mode.shape if complex_shape is None else complex_shape, dtype=complex)


def _why_measured(
    r: int,
    measured: MeasuredModes,
    model_f: NDArray[np.float64],
    distance: NDArray[np.float64],
    agreement: NDArray[np.float64],
    taken: Mapping[int, int],
    settings: PairingSettings,
) -> str:
    tolerance = settings.frequency_tolerance
    f = measured.frequency_hz[r]
    elastic = model_f[model_f > RIGID_HZ]
    if elastic.size == 0 or f > elastic.max() * np.exp(tolerance):
        return "beyond the model's reach: above its highest mode"
    near = np.flatnonzero(distance[r] <= tolerance)
    if near.size == 0:
        return f"no model mode within {100 * tolerance:.0f} %"
    if np.all(np.isfinite(agreement[r, near])):
        best = near[int(np.argmax(agreement[r, near]))]
        alike = near[agreement[r, near] >= settings.least_mac]
        if alike.size == 0:
            return f"shape unlike any: best MAC {agreement[r, best]:.2f} with {model_f[best]:.1f} Hz"
    else:
        best, alike = near[int(np.argmin(distance[r, near]))], near
    free = [k for k in alike if k not in taken]
    if not free:
        other = measured.frequency_hz[taken[int(best)]] if int(best) in taken else np.nan
        return f"closest model mode {model_f[best]:.1f} Hz is taken by the measured mode at {other:.1f} Hz"
    k = free[int(np.argmin(distance[r, free]))]
    shape = f", MAC {agreement[r, k]:.2f}" if np.isfinite(agreement[r, k]) else ""
    off = 100 * (f / model_f[k] - 1)
    return f"frequency and shape together too far off: {off:+.0f} % from {model_f[k]:.1f} Hz{shape}"


def _why_model(
    k: int,
    measured: MeasuredModes,
    modes: Sequence[ModelMode],
    shapes: NDArray[np.complex128],
    system: LinearSystem,
    distance: NDArray[np.float64],
    agreement: NDArray[np.float64],
    taken: Mapping[int, int],
    settings: PairingSettings,
) -> str:
    f = modes[k].frequency_hz
    low, high = _band(measured)
    if f < low:
        return "below band"
    if f > high:
        return "above band"
    if measured.dofs:
        seen = _visibility(modes, shapes, system)
        if seen[k] < settings.node_level * np.max(seen):
            return _unseen(modes[k], system, measured)
        if measured.references:
            struck = [
                i for i, d in enumerate(measured.dofs) if d.point in {x.point for x in measured.references}
            ]
            if struck:
                drive = _visibility(modes, shapes[:, struck], system)
                if drive[k] < settings.node_level * np.max(drive):
                    return "not excited: every point struck is at a node"
    near = np.flatnonzero(distance[:, k] <= settings.frequency_tolerance)
    if near.size == 0:
        return f"no measured mode within {100 * settings.frequency_tolerance:.0f} %"
    closest = int(near[np.argmin(distance[near, k])])
    holder = {r: m for m, r in taken.items()}.get(closest)
    if holder is not None:
        return (
            f"closest measured mode {measured.frequency_hz[closest]:.1f} Hz is taken by the model mode at "
            f"{modes[holder].frequency_hz:.1f} Hz"
        )
    best = float(np.nanmax(agreement[near, k])) if np.any(np.isfinite(agreement[near, k])) else np.nan
    shape = f": best MAC {best:.2f}" if np.isfinite(best) else ""
    return f"no measured mode with its shape{shape}"


def _band(measured: MeasuredModes) -> tuple[float, float]:
    """Where modes were looked for; with an unknown band, some way around the measured modes."""
    if measured.band_hz is not None:
        return measured.band_hz
    if not len(measured):
        return 0.0, np.inf
    return 0.7 * float(measured.frequency_hz.min()), 1.3 * float(measured.frequency_hz.max())


def _visibility(
    modes: Sequence[ModelMode], shapes: NDArray[np.complex128], system: LinearSystem
) -> NDArray[np.float64]:
    """Root-mean-square motion at the sensors, (n_model,), of elastic modes at unit modal mass."""
    level = np.sqrt(np.mean(np.abs(shapes) ** 2, axis=1)) if shapes.shape[1] else np.zeros(len(modes))
    return np.where([m.frequency_hz > RIGID_HZ for m in modes], level, 0.0)


def _unseen(mode: ModelMode, system: LinearSystem, measured: MeasuredModes) -> str:
    """Whether the mode moves bodies without sensors, or has its nodes at the sensors."""
    moving = np.abs(mode.shape) ** 2 * np.diag(system.mass)
    at = int(np.argmax(moving))
    points = {d.point for d in measured.dofs}
    if system.dofs[at] not in points:
        return f"not measured: it moves {system.dofs[at]} alone, which has no sensor"
    return "not excited: all sensors are at a node"
