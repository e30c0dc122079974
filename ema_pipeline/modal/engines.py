"""Pole estimators behind one signature."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.plscf import polyreference_poles
from ema_pipeline.modal.poles import PoleSet
from ema_pipeline.modal.settings import ModalSettings

MAX_REFERENCES = 6
"""More references are combined to this many, the strongest combinations first."""

SPARE_MODES = 12
"""Modes that a model can hold beyond three times the peaks seen."""


MIN_TOP_ORDER = 24
"""The highest order is at least this, so that the numerators can follow what lies outside the band."""

MAX_ORDERS = 30
"""Orders computed per sub-band, about."""


def poles_of_all_orders(
    data: FitData, variance: NDArray[np.float64], n_peaks: int, settings: ModalSettings
) -> PoleSet:
    """Poles of all orders in one sub-band with the engine of the settings.

    Parameters
    ----------
    data : FitData
        Lines of the sub-band.
    variance : ndarray, (n_rows, n_references, n_lines)
        Of the FRFs: rows are scaled to equal noise.
    n_peaks : int
        Peaks seen, which sets the highest order unless the settings do.
    settings : ModalSettings

    Returns
    -------
    PoleSet
        Shapes at all rows (0 at rows that lack a reference); participations at all references.
    """
    n_lines = len(data.omega)
    modes = 3 * n_peaks + SPARE_MODES
    rows, refs = complete_block(data.measured)
    frf = data.frf[np.ix_(rows, refs)]
    row_scale = np.exp(0.5 * np.log(np.maximum(variance[np.ix_(rows, refs)], 1e-300)).mean(axis=(1, 2)))
    scaled = frf / row_scale[:, None, None]
    back = np.eye(len(refs), dtype=np.complex128)
    if settings.engine == "plscf" and len(refs) > MAX_REFERENCES:
        flat = scaled.transpose(1, 0, 2).reshape(len(refs), -1)
        _, vectors = np.linalg.eigh((flat @ flat.conj().T).real)
        back = vectors[:, -MAX_REFERENCES:].astype(np.complex128)
        scaled = np.einsum("oil,ik->okl", scaled, back.real)
    n_ref = scaled.shape[1]
    highest = settings.max_order or max(MIN_TOP_ORDER, int(np.ceil(2 * modes / np.sqrt(n_ref))))
    highest = int(np.clip(highest, 4, max(4, n_lines // 3)))
    lowest = max(2, int(np.ceil(4 / n_ref)))
    step = max(1, (highest - lowest) // MAX_ORDERS)
    orders = list(range(lowest, highest + 1, step))
    found = polyreference_poles(data.omega, scaled, np.ones(n_lines), orders)
    shape = np.zeros((len(found.pole), len(data.measured)), dtype=np.complex128)
    shape[:, rows] = found.shape * row_scale
    part = np.zeros((len(found.pole), data.measured.shape[1]), dtype=np.complex128)
    part[:, refs] = found.participation @ back.T
    return PoleSet(found.order, found.pole, shape, part, found.orders)


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
