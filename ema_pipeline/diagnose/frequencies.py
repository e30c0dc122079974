"""Starts for tests that give frequencies alone.

Without shapes a mode may be taken for any other, and an optimum is only as wide as the distance to the next
frequency: a walk from the base model ends in the nearest one. So the grid of the free parameters is made finer, it is
searched again for every hypothesis, and a parameter out of its tolerance is first held near several multiples of its
nominal value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.diagnose.types import OUT_OF_TOLERANCE
from ema_pipeline.fit.settings import FitSettings
from ema_pipeline.fit.solve import FitProblem, search
from ema_pipeline.rigs.base import ParametricRig

_MULTIPLES = (0.1, 0.3, 3.0, 10.0)
"""A slipped decimal point, and what lies between."""
_HELD = 0.1
_PER_DECADE = 4


def finer_grid(fit: FitSettings) -> FitSettings:
    """Fit settings with a grid of starts that is fine enough for frequencies alone."""
    return fit.model_copy(update={"starts_per_decade": max(_PER_DECADE, fit.starts_per_decade)})


def searched_starts(
    rig: ParametricRig,
    label: str,
    measured: Mapping[str, MeasuredModes],
    fit: FitSettings,
    base: Mapping[str, float],
) -> list[dict[str, float]]:
    """Optima from which a hypothesis is worth refining.

    Parameters
    ----------
    rig : ParametricRig
        Of the hypothesis.
    label : str
        What it adds last, ``id@place``.
    measured, fit
        The data and how they are fitted.
    base : mapping of parameter to value
        Optimum of the model without it.
    """
    family, _, name = label.partition("@")
    if family != OUT_OF_TOLERANCE:
        problem = FitProblem(rig, measured, fit)
        return [problem.space.named(search(problem, base).x)]
    found = []
    p = rig.parameters[name]
    for factor in _MULTIPLES:
        value = p.value * factor
        if not p.minimum <= value <= p.maximum:
            continue
        near = replace(p, value=value, tolerance=_HELD, free=False)
        problem = FitProblem(replace(rig, parameters={**rig.parameters, name: near}), measured, fit)
        found.append(problem.space.named(search(problem, None).x))
    return found
