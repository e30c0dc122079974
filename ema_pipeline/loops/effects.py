"""What the effects of an isolator add to the force of its loops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from ema_pipeline.errors import EmaError, did_you_mean
from ema_pipeline.loops.model import (
    CUBIC,
    DAMPING,
    EXPONENT,
    FORCE,
    GAP,
    QUADRATIC,
    RELAXATION,
    RHO,
    SIGMA,
    SPRING_GAP,
    STIFFNESS,
    TIME,
)

PLACE = "isolator"

PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "quadratic_stiffness": {"stiffness": QUADRATIC},
    "cubic_stiffness": {"stiffness": CUBIC},
    "viscous_damping": {"coefficient": DAMPING},
    "hysteresis": {"force": FORCE, "rho": RHO, "sigma": SIGMA, "exponent": EXPONENT},
    "relaxation": {"stiffness": RELAXATION, "time": TIME},
    "backlash": {"gap": GAP},
}
"""Effects that show in a force loop: the effect's parameters, and their names in the loop's model."""

LINEAR = (STIFFNESS, QUADRATIC, CUBIC, DAMPING, FORCE, RELAXATION)
"""Parameters that enter the force linearly, in the order of their columns."""

DISSIPATIVE = ("viscous_damping", "hysteresis", "relaxation")
"""Effects beside which it matters whether the spring alone has free play."""

NEVER_NEGATIVE = (DAMPING, FORCE, RELAXATION)
"""Negative ones would give energy out every cycle."""


@dataclass(frozen=True)
class Structure:
    """A model of a loop: a linear spring and effects beside it.

    Attributes
    ----------
    effects : tuple of str
        Ids, in the order in which they were added.
    free_exponent : bool
        True where the exponent of the Bouc-Wen model is fitted, else it is 1.
    spring_play : bool
        True where free play is that of the spring alone, else the whole isolator has it.
    """

    effects: tuple[str, ...] = ()
    free_exponent: bool = False
    spring_play: bool = False

    @property
    def key(self) -> frozenset[str]:
        """The effects without their order."""
        return frozenset(self.effects)

    @property
    def terms(self) -> tuple[str, ...]:
        """Linear parameters."""
        mine = {STIFFNESS} | {name for e in self.effects for name in PARAMETERS[e].values()}
        return tuple(t for t in LINEAR if t in mine)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Parameters that do not enter linearly."""
        names = [name for e in self.effects for name in PARAMETERS[e].values() if name not in LINEAR]
        if self.spring_play:
            names = [SPRING_GAP if n == GAP else n for n in names]
        return tuple(n for n in names if n != EXPONENT or self.free_exponent)

    def plus(self, effect: str) -> Structure:
        """With one more effect."""
        return replace(self, effects=(*self.effects, effect))

    def without(self, effect: str) -> Structure:
        """With one effect less."""
        rest = tuple(e for e in self.effects if e != effect)
        exponent = self.free_exponent and "hysteresis" in rest
        return Structure(rest, exponent, self.spring_play and "backlash" in rest)


def effect_ids(labels: Iterable[str]) -> tuple[str, ...]:
    """Ids of ``id@isolator`` labels.

    Raises
    ------
    EmaError
        For effects that a force loop does not show.
    """
    found = []
    for label in labels:
        effect, _, place = label.partition("@")
        if effect not in PARAMETERS or place != PLACE:
            hint = did_you_mean(label, [label_of(e) for e in PARAMETERS])
            raise EmaError(f"effect '{label}' cannot be judged by force-displacement loops{hint}")
        found.append(effect)
    return tuple(found)


def label_of(effect: str) -> str:
    """``id@isolator``."""
    return f"{effect}@{PLACE}"
