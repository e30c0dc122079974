"""Which of several names of the same physics is used, and how large the effect is under that name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ema_pipeline.diagnose.hypotheses import Hypothesis, Name
from ema_pipeline.diagnose.types import EffectSize
from ema_pipeline.effects.base import PlacedEffect
from ema_pipeline.effects.out_of_tolerance import ID as OUT_OF_TOLERANCE
from ema_pipeline.observations.base import Observations
from ema_pipeline.observations.fitting import Fit, Model, refined
from ema_pipeline.observations.size_map import SizeMap

_ALIKE = 3.0
"""Log evidence by which a name's prior may be behind the best one's and still be said."""


@dataclass(frozen=True)
class Named:
    """What a hypothesis is called.

    Attributes
    ----------
    name : Name
    equivalents : tuple of str
        Other labels of the same physics, with sizes that they can have.
    sizes : dict of str to EffectSize
        By the short name of each size.
    advantage : float
        Log prior density of this name's size, and of its sign, against that which the fit took.
    """

    name: Name
    equivalents: tuple[str, ...]
    sizes: dict[str, EffectSize]
    advantage: float

    @property
    def label(self) -> str:
        """``id@place``."""
        return self.name.label


def named(hypothesis: Hypothesis, fit: Fit) -> Named:
    """The name that is said: a rig's own effect first, then what is added, then a part out of tolerance."""
    options = [(n, _advantage(hypothesis, n, fit)) for n in hypothesis.names]
    possible = [(n, a) for n, a in options if np.isfinite(a)] or [(hypothesis.representative, 0.0)]
    best = max(a for _, a in possible)
    near = [(n, a) for n, a in possible if best - a < _ALIKE]
    positive = _unknown(hypothesis, fit) >= 0
    name, advantage = min(near, key=lambda pair: _rank(pair[0], positive))
    others = tuple(n.label for n, a in possible if n.label != name.label and best - a < 2 * _ALIKE)
    return Named(name, others, sizes_of(hypothesis, name, fit), advantage)


def in_said_names(observations: Observations, fit: Fit, said: Sequence[tuple[Hypothesis, Name]]) -> Fit:
    """The same model with its effects under the names that are said, so that every table tells one story."""
    swapped = {h.label: (h, n) for h, n in said if n.label != h.label}
    if not swapped.keys() & set(fit.model.labels):
        return fit
    model, values = Model(), dict(fit.unknowns)
    for placed in fit.model.effects:
        known = {n: fit.model.scales[n] for n in _full_names(placed) if n in fit.model.scales}
        if placed.label in swapped:
            hypothesis, name = swapped[placed.label]
            ratio = hypothesis.representative.relative / name.relative
            for old, new in zip(_full_names(placed), _full_names(name.placed), strict=True):
                values[new] = values.pop(old) * ratio
            placed, known = name.placed, {name.placed.parameter_name(k): v for k, v in name.scales.items()}
        model = model.plus(placed, known)
    unknowns = model.problem(observations).unknowns
    begin = unknowns.clipped(np.array([values[n] for n in unknowns.names]))
    return refined(observations, model, begin, fit.posterior.scatters)


def _full_names(placed: PlacedEffect) -> list[str]:
    return [placed.parameter_name(p.name) for p in placed.effect.parameters]


def sizes_of(hypothesis: Hypothesis, name: Name, fit: Fit) -> dict[str, EffectSize]:
    """Sizes of the effect under a name, with 1 σ."""
    placed = hypothesis.placed
    ratio = hypothesis.representative.relative / name.relative
    found = {}
    for p, own in zip(placed.effect.parameters, name.placed.effect.parameters, strict=True):
        full = placed.parameter_name(p.name)
        i = fit.posterior.unknowns.index[full]
        x, std = float(fit.posterior.x[i]), float(fit.posterior.std[i])
        if name.label == placed.label:
            size = SizeMap.of(p, hypothesis.scales.get(full, p.scale))
            value, slope = size.value(x), size.slope(x)
        else:
            size = SizeMap.of(own, name.scales.get(own.name, own.scale))
            value, slope = size.value(x * ratio), size.slope(x * ratio) * ratio
        found[own.name] = EffectSize(value, std * abs(slope), own.unit, size.learned(fit.posterior, i))
    return found


def averaged_size(sizes: Sequence[EffectSize], weights: Sequence[float]) -> EffectSize:
    """One size over several models that are as probable as their weights say."""
    values, stds = np.array([(s.value, s.std) for s in sizes]).T
    mean = float(values @ weights)
    return EffectSize(mean, float(np.sqrt((stds**2 + (values - mean) ** 2) @ weights)), sizes[0].unit)


def _unknown(hypothesis: Hypothesis, fit: Fit) -> float:
    p = hypothesis.placed.effect.parameters[0]
    return fit.posterior.value(hypothesis.placed.parameter_name(p.name))


def _rank(name: Name, positive: bool) -> tuple[int, str]:
    effect = name.placed.effect
    if effect.id == OUT_OF_TOLERANCE:
        return 2, ""
    if effect.generic:
        return (1 if positive else 3), ""
    return 0, ""


def _advantage(hypothesis: Hypothesis, name: Name, fit: Fit) -> float:
    """Log prior density at the size found, against that of the fit; -inf where the name cannot have that size."""
    x, own = _unknown(hypothesis, fit), name.placed.effect.parameters[0]
    usual = float(np.log(2 * (own.below if x < 0 else 1 - own.below)))
    if name.label == hypothesis.label:
        return usual
    ratio = name.relative / hypothesis.representative.relative
    low, high = SizeMap.of(own, name.scales.get(own.name, own.scale)).bounds
    if not low <= x / ratio <= high:
        return float("-inf")
    return usual + 0.5 * x**2 - 0.5 * (x / ratio) ** 2 - float(np.log(ratio))
