"""Where along the cycle a model leaves the force unexplained, whatever the library holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.observations.loops import LoopProblem

_THIRDS = ("first", "middle", "last")


@dataclass(frozen=True)
class Region:
    """A third of the way up or down, and what the rest of the force acts like there.

    Attributes
    ----------
    place : str
    acts_like : str
        The element that would take most of it away.
    size : float
        Of that element, SI.
    squares : float
        Sum of squares of the rest, in units of its noise.
    """

    place: str
    acts_like: str
    size: float
    squares: float


def regions(problem: LoopProblem, x: NDArray[np.float64]) -> list[Region]:
    """Thirds of the way up and of the way down, those with most of the misfit first."""
    o = problem.observations
    c = o.cycles
    rest = [_without_mean(d.loop.force - f) for d, f in zip(o.data, problem.forces(x), strict=True)]
    std = np.repeat([loop.force_std_n for loop in o.loops], [len(loop.phase) for loop in o.loops])
    whitened = np.concatenate(rest) / std
    third = np.minimum((3 * c.way / c.span).astype(int), 2)
    found = []
    for sign, way in ((1.0, "up"), (-1.0, "down")):
        for k, name in enumerate(_THIRDS):
            mine = (c.direction == sign) & (third == k)
            if mine.any():
                kinds = {
                    "stiffness": c.x[mine],
                    "viscous damping": c.velocity[mine],
                    "dry friction": c.direction[mine],
                }
                columns = {kind: column / std[mine] for kind, column in kinds.items()}
                acts, size = _best(columns, whitened[mine])
                place = f"way {way}, {name} third" + (" (after the reversal)" if k == 0 else "")
                found.append(Region(place, acts, size, float(whitened[mine] @ whitened[mine])))
    return sorted(found, key=lambda one: -one.squares)


def _without_mean(force: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(force - np.mean(force))


def _best(columns: dict[str, NDArray[np.float64]], rest: NDArray[np.float64]) -> tuple[str, float]:
    """The column that takes most of the rest away, and its factor."""
    factors = {k: float(v @ rest) / max(float(v @ v), 1e-300) for k, v in columns.items()}
    best = max(columns, key=lambda k: factors[k] ** 2 * float(columns[k] @ columns[k]))
    return best, factors[best]
