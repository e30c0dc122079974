"""Pole estimators behind one signature."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.basis import mode_columns, residual_columns
from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.lscf import common_denominator_poles
from ema_pipeline.modal.plscf import MAX_DAMPING_RATIO, polyreference_poles
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.sdypy_engine import sdypy_poles
from ema_pipeline.modal.settings import ModalSettings

MAX_REFERENCES = 6
"""More references are combined to this many, the strongest combinations first."""

MODES_PER_PEAK = 3
"""Modes that a model can hold for each peak seen: close ones make one peak."""

SPARE_MODES = 12
"""Modes that it can hold beyond that."""


MIN_TOP_ORDER = 24
"""The highest order is at least this, so that the numerators can follow what lies outside the band."""

MOST_OVER_WANTED = 1.5
"""Highest order over that which the peaks ask for: orders beyond follow noise, with poles that are as stable."""

MAX_ORDERS = 30
"""Orders computed per sub-band, about."""


def poles_of_all_orders(
    data: FitData, noise: NDArray[np.float64], n_peaks: int, settings: ModalSettings
) -> PoleSet:
    """Poles of all orders in one sub-band with the engine of the settings.

    Parameters
    ----------
    data : FitData
        Lines of the sub-band.
    noise : ndarray, (n_rows, n_references)
        Mean logarithm of the variance of every FRF: rows are scaled to equal noise.
    n_peaks : int
        Peaks seen, which sets the highest order unless the settings do.
    settings : ModalSettings

    Returns
    -------
    PoleSet
        Shapes at all rows (0 at rows that lack a reference); participations at all references.
    """
    n_lines = len(data.omega)
    modes = MODES_PER_PEAK * n_peaks + SPARE_MODES
    rows, refs = complete_block(data.measured)
    row_scale = np.exp(0.5 * noise[np.ix_(rows, refs)].mean(axis=1))
    frf = data.frf if data.measured.all() else data.frf[np.ix_(rows, refs)]
    back = np.eye(len(refs))
    if settings.engine == "plscf":
        if len(refs) > MAX_REFERENCES:
            back = _strongest(frf / row_scale[:, None, None], MAX_REFERENCES)
            frf = np.einsum("oil,ik->okl", frf, back)
        n_ref = frf.shape[1]
        orders = _orders(settings, int(np.ceil(2 * modes / np.sqrt(n_ref))), n_lines, max(2, 4 // n_ref), 1)
        found = polyreference_poles(data.omega, frf, np.ones(n_lines), orders, row_scale)
    else:
        scaled = frf / row_scale[:, None, None]
        orders = _orders(settings, 2 * modes, n_lines, 4, 2)
        flat = scaled.reshape(-1, n_lines)
        if settings.engine == "lscf":
            step = float(data.omega[1] - data.omega[0])
            poles = common_denominator_poles(flat, step, 0, n_lines - 1, orders)
            poles = [p + 1j * data.omega[0] for p in poles]
        else:
            every = sdypy_poles(data.omega, flat, orders[-1] // 2)
            poles = [every[n // 2 - 1] for n in orders]
        found = _with_shapes(data.omega, scaled, orders, poles)
    shape = np.zeros((len(found.pole), len(data.measured)), dtype=np.complex128)
    shape[:, rows] = found.shape * row_scale
    part = np.zeros((len(found.pole), data.measured.shape[1]), dtype=np.complex128)
    part[:, refs] = found.participation @ back.T
    return PoleSet(found.order, found.pole, shape, part, found.orders)


def _orders(settings: ModalSettings, wanted: int, n_lines: int, lowest: int, stride: int) -> list[int]:
    """Polynomial orders to compute."""
    highest = max(MIN_TOP_ORDER, wanted)
    if settings.max_order is not None:
        highest = min(settings.max_order, int(MOST_OVER_WANTED * highest))
    highest = int(np.clip(highest, lowest + stride, max(lowest + stride, n_lines // 3)))
    step = stride * max(1, (highest - lowest) // (stride * MAX_ORDERS))
    return list(range(lowest, highest + 1, step))


def _strongest(scaled: NDArray[np.complex128], count: int) -> NDArray[np.float64]:
    """Orthonormal real combinations of references with the most power, (n_references, count)."""
    flat = scaled.transpose(1, 0, 2).reshape(scaled.shape[1], -1)
    return np.asarray(np.linalg.eigh((flat @ flat.conj().T).real)[1][:, -count:])


def _with_shapes(
    omega: NDArray[np.float64],
    frf: NDArray[np.complex128],
    orders: list[int],
    poles: list[NDArray[np.complex128]],
) -> PoleSet:
    """Shapes and participations of poles that come without: least-squares residues, best rank-one parts."""
    keep = [
        p[
            (p.imag > omega[0])
            & (p.imag < omega[-1])
            & (p.real < 0)
            & (-p.real < MAX_DAMPING_RATIO * np.abs(p))
        ]
        for p in poles
    ]
    n_rows, n_ref, n_lines = frf.shape
    flat = frf.reshape(-1, n_lines)
    power = np.concatenate([flat.real, flat.imag], axis=1)
    shapes, parts = [np.zeros((0, n_rows), complex)], [np.zeros((0, n_ref), complex)]
    for p in keep:
        columns = mode_columns(omega, p, np.inf)
        basis = np.concatenate([columns, residual_columns(omega)])
        stacked = np.concatenate([basis.real, basis.imag], axis=1)
        gram = stacked @ stacked.T
        scale = 1 / np.sqrt(np.diag(gram))
        gram = gram * scale[:, None] * scale + 1e-10 * np.eye(len(gram))
        solved = scale[:, None] * np.linalg.solve(gram, scale[:, None] * (stacked @ power.T))
        residues = (solved[0 : 2 * len(p) : 2] + 1j * solved[1 : 2 * len(p) : 2]).reshape(-1, n_rows, n_ref)
        u, s, vh = np.linalg.svd(residues, full_matrices=False)
        shapes.append(u[:, :, 0] * s[:, :1])
        parts.append(vh[:, 0])
    return PoleSet(
        order=np.concatenate([np.full(len(p), n) for n, p in zip(orders, keep, strict=True)]).astype(
            np.int64
        ),
        pole=np.concatenate(keep),
        shape=np.concatenate(shapes),
        participation=np.concatenate(parts),
        orders=tuple(orders),
    )


def complete_block(measured: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and references of the largest fully measured block, references added greedily.

    Returns
    -------
    rows, references : ndarray of int
    """
    best_rows = np.zeros(0, dtype=np.intp)
    best_refs: list[int] = []
    refs: list[int] = []
    rows = np.ones(len(measured), dtype=bool)
    left = set(range(measured.shape[1]))
    while left:
        nxt = max(sorted(left), key=lambda j: int(np.count_nonzero(rows & measured[:, j])))
        rows = rows & measured[:, nxt]
        left.remove(nxt)
        refs.append(nxt)
        if np.count_nonzero(rows) * len(refs) > len(best_rows) * len(best_refs):
            best_rows, best_refs = np.flatnonzero(rows), list(refs)
    return best_rows, np.array(sorted(best_refs), dtype=np.intp)
