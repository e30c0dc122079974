"""Hypotheses: one effect at one place, or one parameter outside its tolerance, on top of a model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.diagnose.types import OUT_OF_TOLERANCE
from ema_pipeline.effects.base import Effect, EffectParameter
from ema_pipeline.effects.library import Library, shipped_effects
from ema_pipeline.effects.rig import rig_with_effects
from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter, Rig

GENERIC = ("spring", "mass", "damper")
"""Effects that only say where and how: used to localise, not to compete with named physics."""

NOTHING = "nothing"
SLIGHT = 0.01
"""Share of the size to expect below which an effect is a difference between parts made to one drawing."""
_SMALL = 1e-3
_OUT = 3.0
"""Tolerances beyond which a parameter counts as out of them."""


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects and parameters out of tolerance on top of the base model.

    Attributes
    ----------
    labels : tuple of str
        ``id@place`` each; ``out_of_tolerance@parameter`` for a parameter. Empty for the base model.
    """

    labels: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return " + ".join(self.labels) or NOTHING

    @property
    def family(self) -> str:
        """Id of the effect added last."""
        return self.labels[-1].partition("@")[0] if self.labels else NOTHING

    @property
    def place(self) -> str:
        return self.labels[-1].partition("@")[2] if self.labels else ""

    @property
    def effects(self) -> tuple[str, ...]:
        """Labels of the effects, parameters out of tolerance left out."""
        return tuple(x for x in self.labels if not x.startswith(f"{OUT_OF_TOLERANCE}@"))

    def plus(self, label: str) -> Hypothesis:
        """With one more effect."""
        return Hypothesis((*self.labels, label))

    def without(self, label: str) -> Hypothesis:
        """With one effect less."""
        if label not in self.labels:
            raise EmaError(f"effect '{label}' is not in the model{did_you_mean(label, self.labels)}")
        return Hypothesis(tuple(x for x in self.labels if x != label))


@dataclass(frozen=True)
class Extra:
    """A coordinate that a hypothesis has and the base model has not.

    Attributes
    ----------
    name : str
        Among the rig's parameters.
    starts : tuple of float
        Values to start a fit from.
    null : float
        Value at which it is absent.
    scale : float
        Size to expect; 0 for a quantity spread evenly over its range. Of the logarithm for a parameter out of its
        tolerance.
    one_sided : bool
    slight : float
        Size below which it is not worth a claim; 0 where there is none.
    """

    name: str
    starts: tuple[float, ...]
    null: float
    scale: float
    one_sided: bool
    slight: float = 0.0


def make_rig(rig: Rig, hypothesis: Hypothesis, library: Library | None, span: float) -> ParametricRig:
    """The rig of a hypothesis; a parameter out of tolerance is free within a factor `span`."""
    made = rig_with_effects(rig, hypothesis.effects, library)
    changed = dict(made.parameters)
    for label in hypothesis.labels:
        family, _, name = label.partition("@")
        if family == OUT_OF_TOLERANCE:
            if name not in rig.parameters:
                raise EmaError(
                    f"rig '{rig.name}' has no parameter '{name}'{did_you_mean(name, rig.parameters)}"
                )
            changed[name] = _freed(rig.parameters[name], span)
    return replace(made, parameters=changed)


def _freed(p: Parameter, span: float) -> Parameter:
    low, high = max(p.minimum, p.value / span), min(p.maximum, p.value * span)
    return replace(p, tolerance=0.0, minimum=low, maximum=high, free=True)


def extras(rig: Rig, hypothesis: Hypothesis, library: Library | None) -> tuple[Extra, ...]:
    """Coordinates that the hypothesis adds, with starts and scales."""
    known = shipped_effects() if library is None else library
    found: list[Extra] = []
    for label in hypothesis.labels:
        family, _, place = label.partition("@")
        if family == OUT_OF_TOLERANCE:
            v = rig.parameters[place].value
            scale = _OUT * rig.parameters[place].tolerance
            found.append(Extra(place, (0.3 * v, 3 * v), v, scale, False))
            continue
        for p in known[family].parameters:
            scale = _scale(p)
            slight = SLIGHT * scale
            found.append(Extra(f"{label}.{p.name}", _starts(p), p.null, scale, p.minimum >= p.null, slight))
    return tuple(found)


def _scale(p: EffectParameter) -> float:
    spread = p.minimum > 0 and np.isfinite(p.maximum) and p.maximum / p.minimum > 5
    return 0.0 if spread or p.unit == "deg" else p.scale


def _starts(p: EffectParameter) -> tuple[float, ...]:
    if p.unit == "deg":
        return tuple(float(v) for v in np.linspace(p.minimum, p.maximum, 5)[:-1])
    if p.minimum > 0:
        grid = (p.start, 0.2 * p.start, 5 * p.start)
        return tuple(v for v in grid if p.minimum <= v <= p.maximum)
    if p.minimum < p.null:
        return (p.start, max(-p.start, 0.9 * p.minimum))
    return (p.start,)


def starting_points(found: Sequence[Extra], most: int = 9) -> list[dict[str, float]]:
    """Combinations of starting values of the added coordinates."""
    grid = product(*(e.starts for e in found))
    points = [dict(zip((e.name for e in found), v, strict=True)) for v in grid]
    return points[:most]


def single_hypotheses(
    rig: Rig,
    configurations: Sequence[str],
    library: Library | None,
    base: Hypothesis | None = None,
    parameters: bool = True,
) -> list[Hypothesis]:
    """All hypotheses that add one effect at one place (or one parameter out of tolerance) to `base`.

    Effects that change the matrices alike, to a factor, are one hypothesis: the first by id is kept, a named
    effect before a generic one. Effects that do not act in any measured configuration, or not on linear
    data, are left out.
    """
    base = base or Hypothesis()
    known = shipped_effects() if library is None else library
    made = rig_with_effects(rig, base.effects, library)
    directions: list[NDArray[np.float64]] = []
    chosen: list[Hypothesis] = []
    for effect_id, place in _named_physics(made, configurations, known):
        label = f"{effect_id}@{place}"
        if label in base.labels:
            continue
        direction = _direction(made, configurations, known[effect_id], place)
        if direction is None:
            continue
        if direction.size and any(_alike(direction, d) for d in directions):
            continue
        directions.append(direction)
        chosen.append(base.plus(label))
    if parameters:
        used = {n for c in configurations for n in rig.used(c)}
        for name, p in rig.parameters.items():
            label = f"{OUT_OF_TOLERANCE}@{name}"
            if name in used and not p.free and p.tolerance > 0 and p.value > 0 and label not in base.labels:
                chosen.append(base.plus(label))
    return chosen


def same_physics(
    rig: Rig, configurations: Sequence[str], library: Library | None, hypothesis: Hypothesis, size: float
) -> tuple[str, ...]:
    """Other labels for what a hypothesis adds last: they change all matrices alike, so no measurement in these
    configurations parts them.

    Parameters
    ----------
    rig, configurations, library
        As for `single_hypotheses`.
    hypothesis : Hypothesis
    size : float
        Of its (only) parameter: effects whose own size would then have a forbidden sign are not the same.
    """
    known = shipped_effects() if library is None else library
    if hypothesis.family not in known:
        return ()
    made = rig_with_effects(rig, Hypothesis(hypothesis.labels[:-1]).effects, library)
    effect = known[hypothesis.family]
    own = _direction(made, configurations, effect, hypothesis.place)
    if own is None or not own.size:
        return ()
    sign = np.sign(size - effect.parameters[0].null)
    found = []
    for other_id, place in _named_physics(made, configurations, known):
        label = f"{other_id}@{place}"
        if label in hypothesis.labels:
            continue
        direction = _direction(made, configurations, known[other_id], place)
        if direction is None or not _alike(own, direction):
            continue
        p = known[other_id].parameters[0]
        wanted = sign * np.sign(own @ direction) * np.sign(p.start - p.null)
        if wanted > 0 or p.minimum < p.null:
            found.append(label)
    return tuple(found)


def _named_physics(rig: Rig, configurations: Sequence[str], known: Library) -> Iterator[tuple[str, str]]:
    """Id of every linear effect but the generic ones, and every place that it has in these configurations."""
    for effect_id in sorted(known):
        effect = known[effect_id]
        if effect_id not in GENERIC and effect.linear:
            for place in dict.fromkeys(
                p for c in configurations for p in effect.find_places(rig.assembly(c))
            ):
                yield effect_id, place


def _direction(
    rig: Rig, configurations: Sequence[str], effect: Effect, place: str
) -> NDArray[np.float64] | None:
    """Change of all matrices by a small effect, scaled to length 1; empty for an effect that adds DOFs or has
    several parameters, None for one that changes nothing."""
    if len(effect.parameters) > 1:
        return np.zeros(0)
    p = effect.parameters[0]
    parts = []
    for c in configurations:
        plain = rig.assembly(c)
        if not effect.fits(plain, place):
            parts.append(np.zeros(4 * len(plain.dofs) ** 2))
            continue
        # A small size could be lost in rounding of the stiffnesses, so the start's own is taken.
        edited = effect.apply(plain, place, {p.name: p.start}).system()
        base = plain.system()
        if edited.mass.shape != base.mass.shape:
            return np.zeros(0)
        parts.append(
            np.concatenate(
                [
                    (edited.mass - base.mass).ravel() * 1e6,
                    (edited.stiffness - base.stiffness).ravel(),
                    (edited.damping - base.damping).ravel() * 1e3,
                    (edited.structural - base.structural).ravel(),
                ]
            )
        )
    whole = np.concatenate(parts)
    size = float(np.linalg.norm(whole))
    return whole / size if size > 0 else None


def _alike(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return a.size == b.size and bool(min(np.linalg.norm(a - b), np.linalg.norm(a + b)) < _SMALL)


def prior_probabilities(
    hypotheses: Sequence[Hypothesis], null_prior: float, parameter_prior: float
) -> dict[str, float]:
    """Prior probability of each hypothesis by label: families share alike, places within a family alike."""
    families: dict[str, int] = {}
    for h in hypotheses:
        families[h.family] = families.get(h.family, 0) + 1
    effects = [f for f in families if f != OUT_OF_TOLERANCE]
    share = parameter_prior if OUT_OF_TOLERANCE in families and effects else 0.0
    if OUT_OF_TOLERANCE in families and not effects:
        share = 1.0
    weights = {NOTHING: null_prior if hypotheses else 1.0}
    for h in hypotheses:
        of_family = share if h.family == OUT_OF_TOLERANCE else (1 - share) / max(len(effects), 1)
        weights[h.label] = (1 - null_prior) * of_family / families[h.family]
    return weights


def describe(hypothesis: Hypothesis, library: Library | None) -> tuple[str, str]:
    """Title and tell-tale signs of the effect added last."""
    if hypothesis.family == OUT_OF_TOLERANCE:
        return (
            f"{hypothesis.place} lies outside its tolerance",
            "all modes that depend on this one parameter off together",
        )
    known: Mapping[str, Effect] = shipped_effects() if library is None else library
    return known[hypothesis.family].title, known[hypothesis.family].signs
