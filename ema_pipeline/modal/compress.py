"""Many rows to few: poles and participations are the same in any real combination of rows.

Scaled to equal noise, the strongest combinations hold all that many rows know about the poles, at a
fraction of the work. Only the shapes need every row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.modal.data import FitData
from ema_pipeline.modal.noise import Noise

Real = NDArray[np.float64]

MAX_ROWS = 20


def compress(data: FitData, hits: Noise | None, start: Noise) -> tuple[FitData, Noise | None, Noise]:
    """The strongest combinations of rows with their noise; the data as they are where rows are few or gappy.

    Parameters
    ----------
    data : FitData
    hits : Noise or None
    start : Noise
    """
    if len(data.frf) <= MAX_ROWS or not data.measured.all():
        return data, hits, start
    level = np.exp(-0.5 * np.log(start.variance).mean(axis=(1, 2)))
    scaled = (data.frf * level[:, None, None]).reshape(len(level), -1)
    gram = scaled.real @ scaled.real.T + scaled.imag @ scaled.imag.T
    mixer = np.linalg.eigh(gram)[1][:, ::-1][:, :MAX_ROWS].T * level  # (kept, rows)
    frf = np.einsum("ko,oil->kil", mixer, data.frf, optimize=True)
    small = replace(
        data,
        frf=frf,
        variance=np.einsum("ko,oil->kil", mixer**2, data.variance, optimize=True),
        measured=np.ones(frf.shape[:2], dtype=bool),
    )

    def mixed(noise: Noise) -> Noise:
        own = np.einsum("ko,oil->kil", mixer**2, noise.own, optimize=True)
        if data.transposed:  # rows are inputs, whose force noise is independent
            return Noise(np.einsum("ko,oil->kil", mixer**2, noise.common, optimize=True), own)
        power = np.sum(np.abs(data.frf) ** 2, axis=0)
        alpha = noise.common.sum(axis=0) / np.where(power > 0, power, 1.0)
        return Noise(alpha * np.abs(frf) ** 2, own)

    return small, None if hits is None else mixed(hits), mixed(start)
