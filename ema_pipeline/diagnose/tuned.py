"""Sizes of an effect with coordinates of its own that put one of its modes at a measured frequency.

An unmeasured mass on a spring shows in the measured modes by one or two further modes and by little else. Tried
blindly, its sizes hardly ever put that mode within the reach of a fit. But the mass that does can be solved for: with
all other sizes given, ``(K - λM₀)φ = mλEφ`` is a linear eigenproblem in the mass m, for M = M₀ + mE.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from ema_pipeline.diagnose.hypotheses import Extra
from ema_pipeline.errors import EmaError
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.rigs.base import ParametricRig

_REACH = 100.0
"""Other sizes are tried from a hundredth of their start to a hundred times it."""
_STEPS = 13
_MOST_MODES = 6


def tuned_sizes(
    rig: ParametricRig,
    moved: Sequence[Extra],
    base: Mapping[str, float],
    unexplained: Sequence[tuple[str, float]],
) -> list[dict[str, float]]:
    """Sizes of what a hypothesis adds for which the rig has a mode at an unexplained frequency.

    Parameters
    ----------
    rig : ParametricRig
        Of the hypothesis.
    moved : sequence of Extra
        What it adds.
    base : mapping of parameter to value
        Optimum of the poorer model.
    unexplained : sequence of (str, float)
        Configuration and frequency (Hz) of measured modes that the poorer model does not have.

    Returns
    -------
    list of dict
        Empty for an effect without a size that is a mass of its own and nothing else.
    """
    found: list[dict[str, float]] = []
    for configuration, hz in unexplained[:_MOST_MODES]:
        first = {e.name: e.starts[0] for e in moved}
        mass = next((e for e in moved if _is_mass(rig, configuration, {**base, **first}, e)), None)
        if mass is None:
            continue
        others = [e for e in moved if e is not mass]
        for sizes in product(*(_grid(rig, e) for e in others)):
            given = {e.name: v for e, v in zip(others, sizes, strict=True)}
            p = rig.parameters[mass.name]
            for value in _masses(rig, configuration, {**base, **given}, mass, hz):
                if p.minimum < value < p.maximum:
                    found.append({**given, mass.name: value})
    return found


def _grid(rig: ParametricRig, e: Extra) -> Sequence[float]:
    p = rig.parameters[e.name]
    if p.unit == "deg":
        return e.starts
    values = e.starts[0] * np.geomspace(1 / _REACH, _REACH, _STEPS)
    return [float(v) for v in values if p.minimum < v < p.maximum]


def _system(rig: ParametricRig, configuration: str, values: Mapping[str, float]) -> LinearSystem | None:
    try:
        return rig.system(configuration, {n: v for n, v in values.items() if n in rig.parameters})
    except EmaError:  # the effect does not fit this configuration
        return None


def _is_mass(rig: ParametricRig, configuration: str, values: Mapping[str, float], e: Extra) -> bool:
    """True for a size that adds to the mass matrix and to no other."""
    one = _system(rig, configuration, values)
    two = _system(rig, configuration, {**values, e.name: 2 * values[e.name]})
    if one is None or two is None or one.mass.shape != two.mass.shape:
        return False
    return bool(np.any(one.mass != two.mass) and np.array_equal(one.stiffness, two.stiffness))


def _masses(
    rig: ParametricRig, configuration: str, values: Mapping[str, float], mass: Extra, hz: float
) -> Iterator[float]:
    start = mass.starts[0]
    one = _system(rig, configuration, {**values, mass.name: start})
    two = _system(rig, configuration, {**values, mass.name: 2 * start})
    if one is None or two is None:
        return
    per_mass: NDArray[np.float64] = (two.mass - one.mass) / start
    without = one.mass - start * per_mass
    squared = (2 * np.pi * hz) ** 2
    scale = np.sqrt(np.diag(one.stiffness) + squared * np.diag(one.mass))
    a = (one.stiffness - squared * without) / np.outer(scale, scale)
    b = squared * per_mass / np.outer(scale, scale)
    roots = scipy.linalg.eigvals(a, b)
    real = roots[np.isfinite(roots) & (np.abs(roots.imag) < 1e-6 * np.abs(roots))].real
    # a support alike in x and y has every root twice, up to rounding
    kept: list[float] = []
    for root in sorted(float(r) for r in real if r > 0):
        if not kept or root > 1.01 * kept[-1]:
            kept.append(root)
    yield from kept
