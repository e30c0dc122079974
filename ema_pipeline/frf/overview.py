"""Many FRFs at a glance: the mode indicator, and the few that show most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet

FRFS_SHOWN = 6


def representative_frfs(frfs: FrfSet, count: int = FRFS_SHOWN) -> tuple[tuple[int, int], ...]:
    """Indices (output, input) of the FRFs to show: driving points first, then the strongest of each body.

    Parameters
    ----------
    frfs : FrfSet
    count : int
        At most this many.
    """
    measured = frfs.hits > 0
    driving = [
        (o, i)
        for i, inp in enumerate(frfs.inputs)
        for o, out in enumerate(frfs.outputs)
        if out.point == inp.point and measured[o, i]
    ]
    if len(driving) >= count:
        return tuple(driving[:count])
    low, high = frfs.band_hz
    inside = slice(np.searchsorted(frfs.frequency_hz, low), np.searchsorted(frfs.frequency_hz, high, "right"))
    power = np.array([np.mean(np.abs(row[:, inside]) ** 2, axis=1) for row in frfs.frf])
    level = np.where(measured, np.sqrt(power), 0.0)
    chosen = list(driving)
    bodies = {frfs.outputs[o].body for o, _ in driving}
    order = [divmod(int(k), len(frfs.inputs)) for k in np.argsort(-np.nan_to_num(level), axis=None)]
    # one FRF of each body not seen yet, strongest first; then whatever is strongest
    for fresh_only in (True, False):
        for o, i in order:
            if len(chosen) >= count:
                break
            if (o, i) in chosen or not measured[o, i] or (fresh_only and frfs.outputs[o].body in bodies):
                continue
            chosen.append((o, i))
            bodies.add(frfs.outputs[o].body)
    return tuple(chosen)


def cmif(frf: NDArray[np.complex128], count: int = 4) -> NDArray[np.float64]:
    """Complex mode indicator function: singular values of the FRF matrix line by line.

    Parameters
    ----------
    frf : complex ndarray, (n_outputs, n_inputs, n_lines)
        NaN where not measured; such an FRF counts as zero.
    count : int
        Number of singular values wanted, largest first.

    Returns
    -------
    ndarray, (min(count, n_outputs, n_inputs), n_lines)

    References
    ----------
    Shih, C. Y., Tsuei, Y. G., Allemang, R. J. & Brown, D. L., "Complex mode indication function and its
    applications to spatial domain parameter estimation", Mech. Syst. Signal Process. 2(4), 1988.
    """
    h = np.where(np.isfinite(frf), frf, 0.0)
    if h.shape[1] > h.shape[0]:
        h = h.swapaxes(0, 1)
    h = np.ascontiguousarray(h.transpose(2, 0, 1))
    gram = h.conj().transpose(0, 2, 1) @ h
    squares = np.linalg.eigvalsh(gram)[:, ::-1][:, :count]
    return np.sqrt(np.maximum(squares, 0.0)).T
