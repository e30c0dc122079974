"""What sizes of effects would have to change by to do what larger motions do.

Larger motions are as smaller lengths, forces and rates: friction of half the force at half the rate does to a motion
what the whole does to one of twice the amplitude. So the derivative by the scale of all amplitudes follows from those
by sizes, and needs no motion of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.mechanics.laws import AT_LARGER_MOTION, Nonlinear

_ALIKE = 1e-6


def as_larger_motions(
    elements: Sequence[Nonlinear], changed: Sequence[Sequence[Nonlinear]], steps: Sequence[float]
) -> NDArray[np.float64] | None:
    """Changes of sizes, per logarithm of all amplitudes, that do what larger motions do.

    Parameters
    ----------
    elements : sequence of Nonlinear
    changed : sequence of sequence of Nonlinear
        The same with one size a small step on, of every size.
    steps : sequence of float

    Returns
    -------
    ndarray, (n_sizes,), or None
        None where sizes alone cannot do it: some element has other numbers besides, or a law of its own.
    """
    laws = [[e.law for e in some] for some in (elements, *changed)]
    if any(None in of or len(of) != len(elements) for of in laws):
        return None
    numbers = np.array(laws, float)
    kind, numbers = numbers[0, :, 0].astype(int), numbers[:, :, 1:]
    finite = np.isfinite(numbers).all(axis=0)
    now, *others = numbers[:, finite]
    wanted = (np.array(AT_LARGER_MOTION)[kind] * numbers[0])[finite]
    rows = np.array([*((other - now) / step for other, step in zip(others, steps, strict=True)), wanted])
    rows /= np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    by_size, wanted = rows[:-1].T, rows[-1]
    found = np.linalg.lstsq(by_size, wanted)[0]
    alike = np.max(np.abs(by_size @ found - wanted), initial=0.0) < _ALIKE
    return np.asarray(found) if alike else None
