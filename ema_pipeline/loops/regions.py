"""Where in the loop a model fails, whatever the library holds."""

from __future__ import annotations

import numpy as np

from ema_pipeline.diagnose.types import Localisation
from ema_pipeline.loops.fitting import Fitted
from ema_pipeline.loops.loop_set import LoopSet

_THIRDS = ("first", "middle", "last")
_LISTED = 3


def regions(loops: LoopSet, fitted: Fitted, widening: float) -> tuple[Localisation, ...]:
    """Thirds of the way up and of the way down that hold most of the misfit, and how it acts there.

    Parameters
    ----------
    loops : LoopSet
    fitted : Fitted
    widening : float
        See `ema_pipeline.loops.search.widening_of`.

    Returns
    -------
    tuple of Localisation
        Worst first; `score` is the sum of squares of the region in widened variances, `size` the element that
        would take most of it away there.
    """
    motion = loops.motion
    third = np.minimum((3 * motion.way / motion.span).astype(int), 2)
    x = motion.x
    speed = motion.velocity
    found = []
    for sign, way in ((1.0, "up"), (-1.0, "down")):
        for k, name in enumerate(_THIRDS):
            mine = (motion.direction == sign) & (third == k)
            if not mine.any():
                continue
            residual = -fitted.residual[mine]
            std = np.concatenate([np.full(len(one.force), one.force_std_n) for one in loops.loops])[mine]
            acts, size = "", 0.0
            most = -1.0
            for kind, column in (
                ("stiffness", x[mine]),
                ("viscous damping", speed[mine]),
                ("dry friction", sign),
            ):
                c = column / std
                size_here = float(np.sum(c * residual) / max(float(np.sum(c**2)), 1e-300))
                taken = size_here**2 * float(np.sum(c**2))
                if taken > most:
                    most, acts, size = taken, kind, size_here
            where = f"way {way}, {name} third" + (" (after the reversal)" if k == 0 else "")
            found.append(Localisation(where, acts, size, float(residual @ residual) / widening))
    return tuple(sorted(found, key=lambda one: -one.score)[:_LISTED])
