"""Random cases of the calibration study: which rig, what is hidden in it, and its raw data."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from study_own_rigs import BASE_DAMPING, OwnRig, draw_rig

from ema_pipeline.effects.library import shipped_effects
from ema_pipeline.observations.parts import dependence
from ema_pipeline.rigs import load_rig
from ema_pipeline.rigs.types import Rig
from ema_pipeline.simulate import SimulatedCampaign, simulate_campaign
from ema_pipeline.simulate.imperfections import LEVELS

Kind = Literal["own", "planetary", "gearbox", "isolator", "levels"]
Quality = Literal["good", "normal"]
KINDS: tuple[Kind, ...] = ("own", "planetary", "gearbox", "isolator", "levels")

EFFECTS_OF_CASE = (0, 1, 1, 2, 1)
"""Number of hidden effects of each five cases."""

Range = tuple[str, float, float]
"""A parameter and the range of its sizes, even over the logarithm: from hardly to clearly visible."""

PLANETARY: dict[str, tuple[Range, ...]] = {
    "mesh_stiffness_loss": (("fraction", 0.05, 0.6),),
    "planet_bearing_mistune": (("relative_change", 0.05, 0.6),),
    "planet_mass_mistune": (("mass", 0.02, 0.3),),
    "bearing_anisotropy": (("relative_stiffness", 0.01, 0.6),),
    "shaft_torsion": (("stiffness", 1e3, 1e6),),
    "shaft_coupling": (("stiffness", 5e3, 5e6),),
    "sensor_mass": (("mass", 0.02, 0.2),),
    "flexible_support": (("mass", 1.0, 6.0), ("stiffness", 5e6, 5e7)),
    "local_damper": (("coefficient", 5.0, 200.0),),
    "hysteretic_damping": (("loss_factor", 0.01, 0.1),),
    "gyroscopic": (("coefficient", 5.0, 200.0),),
}
GEARBOX: dict[str, tuple[Range, ...]] = {
    "mesh_stiffness_loss": (("fraction", 0.05, 0.6),),
    "mass": (("mass", 0.02, 0.3),),
    "spring": (("stiffness", 1e5, 1e7),),
    "damper": (("coefficient", 10.0, 300.0),),
}
BY_LEVEL: dict[str, tuple[Range, ...]] = {
    "bearing_cubic": (("stiffness", 2e11, 5e12),),
    "bearing_quadratic": (("stiffness", 1e8, 1.5e9),),
    "dry_friction": (("force", 0.1, 5.0),),
    "mesh_backlash": (("preload", 5e-8, 2e-6),),
}
LEVELS_N = (30.0, 100.0, 300.0)
ISOLATOR_FORCE = (0.002, 0.3)
"""Force of an isolator's effect over that of its spring at the largest amplitude."""

SAME_KIND = (
    ("mass", "sensor_mass", "planet_mass_mistune"),
    ("spring", "shaft_torsion", "shaft_coupling", "planet_bearing_mistune", "bearing_anisotropy"),
    ("damper", "local_damper"),
)
"""Names of one kind of change: a library that lacks one of them must lack all."""


@dataclass(frozen=True)
class Truth:
    """A hidden effect.

    Attributes
    ----------
    label : str
        ``id@place``.
    parameter : str
        Its first parameter.
    size : float
    also : str
        Parameter of the rig that would have to be off by the same physics; empty where there is none.
    """

    label: str
    parameter: str
    size: float
    also: str = ""

    @property
    def family(self) -> str:
        """Id of the effect."""
        return self.label.partition("@")[0]


@dataclass(frozen=True)
class Case:
    """One simulated test.

    Attributes
    ----------
    kind, level : str
    number : int
        Seeds everything that is random.
    without : bool
        True where the library lacks the hidden effect's kind.
    """

    kind: Kind
    level: Quality
    number: int
    without: bool = False

    @property
    def seed(self) -> int:
        """Seed of the simulator."""
        return 1000 * self.number + 10 * KINDS.index(self.kind) + ("good", "normal").index(self.level)

    def random(self) -> np.random.Generator:
        """Random numbers of the drawing."""
        return np.random.default_rng([self.seed, int(self.without)])

    @property
    def effects(self) -> int:
        """How many effects are hidden."""
        if self.without:
            return 1
        return EFFECTS_OF_CASE[self.number % len(EFFECTS_OF_CASE)]


@dataclass(frozen=True)
class Made:
    """What was simulated: the rig in words, the hidden effects, the true values of the model's parameters."""

    rig: str
    truth: tuple[Truth, ...]
    values: dict[str, float]


def lacking(truth: Sequence[Truth]) -> set[str]:
    """Ids that the library must lack so that it lacks what is hidden."""
    return {other for t in truth for other in next((g for g in SAME_KIND if t.family in g), (t.family,))}


def make(case: Case, raw: Path) -> Made:
    """Simulate a case into a raw folder, its rig.toml beside the data."""
    return _MAKERS[case.kind](case, raw, case.random())


def _size(random: np.random.Generator, low: float, high: float) -> float:
    return float(f"{np.exp(random.uniform(np.log(low), np.log(high))):.4g}")


def _draw(
    rig: Rig,
    configurations: Sequence[str],
    sizes: dict[str, tuple[Range, ...]],
    count: int,
    random: np.random.Generator,
) -> list[tuple[Truth, str]]:
    """Effects of different families at random places, with the text that the simulator takes."""
    drawn: list[tuple[Truth, str]] = []
    for family in random.permutation(sorted(set(sizes) & set(shipped_effects())))[:count]:
        effect = shipped_effects()[str(family)]
        places = [p for c in configurations for p in effect.places(rig, c)]
        place = str(random.choice(list(dict.fromkeys(places))))
        values = [(name, _size(random, low, high)) for name, low, high in sizes[str(family)]]
        if family in ("planet_bearing_mistune", "bearing_quadratic") and random.random() < 0.5:
            values[0] = (values[0][0], -values[0][1])
        if family == "bearing_anisotropy":
            values.append(("angle_deg", float(f"{random.uniform(-90, 90):.1f}")))
        text = f"{family}@{place}:" + ",".join(f"{name}={value}" for name, value in values)
        also = f"{place}_mass" if family == "sensor_mass" and f"{place}_mass" in rig.parameters else ""
        drawn.append((Truth(f"{family}@{place}", *values[0], also), text))
    return drawn


def _own(case: Case, raw: Path, random: np.random.Generator) -> Made:
    own = draw_rig(random, case.number)
    drawn = [_own_effect(own, random) for _ in range(case.effects)]
    if len({t.label for t, _ in drawn}) < len(drawn):
        drawn = drawn[:1]
    raw.mkdir(parents=True)
    true_file = raw.parent / "true.toml"
    true_file.write_text(own.toml(true=True), encoding="utf-8")
    bodies = list(own.masses)
    struck = [bodies[0], bodies[-1]]
    impacts = [f"{body}.{d}" for body, d in zip(struck, (own.directions * 2)[:2], strict=True)]
    simulate_campaign(
        raw, true_file, effects=[text for _, text in drawn], impacts=impacts, hits=3, duration_s=4.0,
        sample_rate_hz=2560.0, contact_s=1e-3, format="hdf5", seed=case.seed, imperfection=case.level,
        part_scatter=0.0, scatter=0.0,
    )  # fmt: skip
    (raw / "rig.toml").write_text(own.toml(true=False), encoding="utf-8")
    values = {f"k{i}": s.true for i, s in enumerate(own.springs, 1)}
    return Made(own.name, tuple(t for t, _ in drawn), values)


def _own_effect(own: OwnRig, random: np.random.Generator) -> tuple[Truth, str]:
    """A spring, mass or damper at a random DOF; springs and dampers also between two."""
    family = str(random.choice(["spring", "mass", "damper"]))
    dof = str(random.choice(own.dofs))
    body, _, direction = dof.partition(".")
    stiffness = float(np.exp(np.mean([np.log(s.true) for s in own.springs])))
    if family == "mass":
        plane = len(own.directions) > 1
        most = min(0.5 * own.masses[body][1], 1.0) if plane else 0.5 * own.masses[body][1]
        size = _size(random, 0.03 * own.masses[body][1], most)  # a sensor has no more than 1 kg
        # A mass goes with its body in every direction.
        label = f"sensor_mass@{body}" if plane else f"mass@{dof}"
        return Truth(label, "mass", size), f"{label}:mass={size}"
    others = [f"{b}.{direction}" for b in own.masses if b != body]
    place = f"{dof}-{random.choice(others)}" if random.random() < 0.4 else dof
    if family == "spring":
        size = _size(random, 0.03 * stiffness, 1.0 * stiffness)
        also = next((f"k{i}" for i, s in enumerate(own.springs, 1) if s.joins(place)), "")
        return Truth(f"spring@{place}", "stiffness", size, also), f"spring@{place}:stiffness={size}"
    of_base = 2 * BASE_DAMPING * float(np.sqrt(stiffness * own.masses[body][1]))
    size = _size(random, 0.5 * of_base, 20 * of_base)
    return Truth(f"damper@{place}", "coefficient", size), f"damper@{place}:coefficient={size}"


def _planets_file(raw: Path, base: str, planets: int) -> Path:
    """A rig file beside the raw folder."""
    raw.mkdir(parents=True)
    file = raw.parent / "planets.toml"
    file.write_text(f'base = "{base}"\n[geometry]\nplanets = {planets}\n', encoding="utf-8")
    return file


def _free_values(rig: Rig, random: np.random.Generator) -> dict[str, float]:
    """Half a decade for parameters that the data alone determine."""
    return {
        name: float(p.value * 10 ** random.uniform(-0.2, 0.3)) for name, p in rig.parameters.items() if p.free
    }


def _shipped(
    case: Case,
    raw: Path,
    random: np.random.Generator,
    base: str,
    planets: int,
    sizes: dict[str, tuple[Range, ...]],
    several: float = 0.6,
    **settings: Any,
) -> Made:
    """A rig that ships with the program, its parameters drawn from their tolerances.

    `several` is the probability that all its configurations are tested, and not one.
    """
    file = _planets_file(raw, base, planets)
    rig = load_rig(file)
    configurations = tuple(rig.configurations)
    if len(configurations) > 1 and random.random() >= several:
        configurations = (str(random.choice(configurations)),)
    drawn = _draw(rig, configurations, sizes, case.effects, random)
    made = simulate_campaign(
        raw, file, configurations=configurations, effects=[text for _, text in drawn],
        values=_free_values(rig, random), scatter=1.0, format="hdf5", seed=case.seed, imperfection=case.level,
        **settings,
    )  # fmt: skip
    values = {n: v for n, v in made.values.items() if "@" not in n} | _of_sole_parts(rig, made)
    return Made(
        f"{base}, {planets} planets, {' + '.join(configurations)}", tuple(t for t, _ in drawn), values
    )


def _of_sole_parts(rig: Rig, made: SimulatedCampaign) -> dict[str, float]:
    """True values of parameters that one part alone has: what is stated of them is that part's."""
    truth = json.loads((made.folder / "truth.json").read_text(encoding="utf-8"))
    parts = truth.get("imperfections", {}).get("parts", {})
    return {
        name: made.values[name] * parts.get(part.rpartition(" (")[0], 1.0) ** power
        for name, (part, power) in dependence(rig).sole_parts.items()
    }


def _planetary(case: Case, raw: Path, random: np.random.Generator) -> Made:
    return _shipped(case, raw, random, "planetary", int(random.integers(2, 6)), PLANETARY)


def _gearbox(case: Case, raw: Path, random: np.random.Generator) -> Made:
    return _shipped(case, raw, random, "gearbox", int(random.integers(3, 6)), GEARBOX)


def _levels(case: Case, raw: Path, random: np.random.Generator) -> Made:
    planets = int(random.integers(2, 4))
    return _shipped(case, raw, random, "planetary", planets, BY_LEVEL, 0.0, peak_force_n=LEVELS_N)


def _isolator(case: Case, raw: Path, random: np.random.Generator) -> Made:
    """Nine loops; force and displacement have a gain each."""
    from ema_pipeline.loops.simulate import PRINTED, write_sine_tests

    k, x, omega = PRINTED["stiffness"] * float(np.exp(0.2 * random.standard_normal())), 2e-3, 2 * np.pi * 12.0
    unit = {
        "quadratic_stiffness": ("stiffness", k / x),
        "cubic_stiffness": ("stiffness", k / x**2),
        "viscous_damping": ("coefficient", k / omega),
        "hysteresis": ("force", k * x),
        "relaxation": ("stiffness", k),
        "backlash": ("gap", x),
    }
    names = {
        "hysteresis": "hysteresis_force",
        "relaxation": "relaxation_stiffness",
        "backlash": "backlash_gap",
    }
    values, truth = {"stiffness": k}, []
    for family in random.permutation(sorted(unit))[: case.effects]:
        parameter, scale = unit[str(family)]
        size = _size(random, ISOLATOR_FORCE[0] * scale, ISOLATOR_FORCE[1] * scale)
        truth.append(Truth(f"{family}@isolator", parameter, size))
        values[names.get(str(family), str(family))] = size
        if family == "hysteresis":
            values |= {
                "hysteresis_rho": PRINTED["hysteresis_rho"],
                "hysteresis_sigma": float(random.uniform(0.15, 1)),
            }
        if family == "relaxation":
            values["relaxation_time"] = float(random.uniform(0.7, 4.0) / omega)
    write_sine_tests(raw, values, seed=case.seed)
    gains = np.exp(LEVELS[case.level].calibration * random.standard_normal(2))
    for file in raw.glob("*.csv"):
        table = np.loadtxt(file, delimiter=",", skiprows=1) * gains
        np.savetxt(file, table, delimiter=",", header="force,displacement", comments="", fmt="%.9g")
    return Made("isolator", tuple(truth), {"stiffness": k})


_MAKERS: dict[Kind, Callable[[Case, Path, np.random.Generator], Made]] = {
    "own": _own,
    "planetary": _planetary,
    "gearbox": _gearbox,
    "isolator": _isolator,
    "levels": _levels,
}
