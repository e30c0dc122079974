"""Random rigs of a user's own for the calibration study: masses and springs as chains, frames and branches."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

SHAPES = ("chain", "frame", "branch")
MASS_KG = (0.5, 5.0)
STIFFNESS_N_PER_M = (1e5, 1e6)
"""Natural frequencies from some ten to three hundred hertz."""
STIFFNESS_TOLERANCE = 0.05
MASS_TOLERANCE = 0.005
"""How well the user knows springs and masses, 1 σ."""
BASE_DAMPING = 0.01


@dataclass(frozen=True)
class OwnSpring:
    """A spring between two DOFs, or to ground where `b` is empty; stated and true stiffness, N/m."""

    a: str
    b: str
    stated: float
    true: float

    def joins(self, place: str) -> bool:
        """True where an effect at `place`, ``"m1.x"`` or ``"m1.x-m2.x"``, lies beside this spring."""
        return set(place.split("-")) == {self.a, self.b} - {""}


@dataclass(frozen=True)
class OwnRig:
    """A rig as its user states it and as it is.

    Attributes
    ----------
    name : str
    directions : tuple of str
        In which every mass moves.
    masses : dict of str to (float, float)
        Body to stated and true mass, kg.
    springs : tuple of OwnSpring
    """

    name: str
    directions: tuple[str, ...]
    masses: dict[str, tuple[float, float]]
    springs: tuple[OwnSpring, ...]

    @property
    def dofs(self) -> tuple[str, ...]:
        """All coordinates."""
        return tuple(f"{body}.{d}" for body in self.masses for d in self.directions)

    def toml(self, true: bool) -> str:
        """The rig file, as stated or as the rig truly is."""
        lines = [f'name = "{self.name}"', f"modal_damping_ratio = {BASE_DAMPING}", "", "[parameters]"]
        for i, s in enumerate(self.springs, 1):
            value = s.true if true else s.stated
            lines.append(f'k{i} = {{ value = {value!r}, unit = "N/m", tolerance = {STIFFNESS_TOLERANCE} }}')
        for body, values in self.masses.items():
            for d in self.directions:
                lines += ["", "[[masses]]", f'at = "{body}.{d}"', f"value = {values[true]!r}"]
        for i, s in enumerate(self.springs, 1):
            place = f'between = ["{s.a}", "{s.b}"]' if s.b else f'at = "{s.a}"'
            lines += ["", "[[springs]]", f'name = "k{i}"', f'value = "k{i}"', place]
        return "\n".join(lines) + "\n"


def draw_rig(random: np.random.Generator, number: int) -> OwnRig:
    """A rig of 2 to 8 masses; a third of them moves in a plane."""
    shape = str(random.choice(SHAPES))
    plane = shape == "frame"
    count = int(random.integers(2, 5 if plane else 9))
    free = bool(random.random() < 0.25) and not plane and count > 2
    bodies = [f"m{i}" for i in range(1, count + 1)]
    masses = {}
    for body in bodies:
        stated = float(f"{_log_uniform(random, MASS_KG):.3g}")
        masses[body] = (stated, float(stated * np.exp(MASS_TOLERANCE * random.standard_normal())))
    directions = ("x", "y") if plane else ("x",)
    links = {"chain": _chain, "frame": _frame, "branch": _branch}[shape](bodies, free, random)
    springs = []
    for a, b in links:
        for d in directions:
            stated = float(f"{_log_uniform(random, STIFFNESS_N_PER_M):.4g}")
            true = float(stated * np.exp(STIFFNESS_TOLERANCE * random.standard_normal()))
            springs.append(OwnSpring(f"{a}.{d}", f"{b}.{d}" if b else "", stated, true))
    kind = "free" if free else "fixed"
    return OwnRig(f"{kind} {shape} {number}", directions, masses, tuple(springs))


def _log_uniform(random: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(random.uniform(*np.log(bounds))))


Links = list[tuple[str, str]]


def _chain(bodies: list[str], free: bool, random: np.random.Generator) -> Links:
    """Neighbours linked; the first, and perhaps the last, to ground unless free."""
    links = list(pairwise(bodies))
    if free:
        return links
    return [(bodies[0], ""), *links, *([(bodies[-1], "")] if random.random() < 0.5 else [])]


def _frame(bodies: list[str], free: bool, random: np.random.Generator) -> Links:
    """Storeys over a base, with a brace that skips one."""
    links = [(bodies[0], ""), *zip(bodies[1:], bodies, strict=False)]
    return [*links, (bodies[2], bodies[0])] if len(bodies) > 2 else links


def _branch(bodies: list[str], free: bool, random: np.random.Generator) -> Links:
    """Each mass on one of those before it."""
    links = [(body, str(random.choice(bodies[:i]))) for i, body in enumerate(bodies) if i]
    return links if free else [(bodies[0], ""), *links]
