"""Planetary gear in its plane: where the bodies are drawn, and how a shape moves them.

The drawing is a scheme: radii are those of a set that meshes, not of the real one. A displacement in x and y
and a rotation u = rθ keep their proportion: a point of the drawn base circle moves by u.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.assurance import real_shape
from ema_pipeline.report.results import ConfigurationResults

_PLANET = re.compile(r"planet(\d+)$")
_CENTRAL = ("carrier", "ring", "sun")

FILLS = {"carrier": "#f2d8c0", "ring": "#dcdcdc", "sun": "#f6ecb0", "planet": "#cfe3f1"}
"""Colours of the bodies in every drawing."""


@dataclass(frozen=True)
class GearBody:
    """One body: centre (x, y), radius of its base circle as drawn, number of teeth, its angle ψ (planets)."""

    name: str
    x: float
    y: float
    radius: float
    teeth: int
    psi: float = 0.0


@dataclass(frozen=True)
class GearLayout:
    """All bodies, drawn in this order; `reach` is the radius of a circle round the whole set.

    `torsional`: every centre is held but those of the planets, which the carrier takes along, and the ring does
    not move. Then u is all that there is to measure.
    """

    bodies: tuple[GearBody, ...]
    reach: float
    torsional: bool = False


@dataclass(frozen=True)
class Motion:
    """Complex motion of a body: x, y in the fixed frame and u = rθ; `missing` names what is not known."""

    x: complex
    y: complex
    u: complex
    missing: tuple[str, ...] = ()


def gear_layout(points: Iterable[str]) -> GearLayout | None:
    """Layout for the bodies that the DOFs name; None where they are not those of a planetary gear.

    Parameters
    ----------
    points : iterable of str
        DOFs without sign, e.g. ``"sun.x"``.
    """
    bodies = {p.split(".")[0] for p in points}
    numbers = sorted(int(m[1]) for b in bodies if (m := _PLANET.match(b)))
    if not numbers or "sun" not in bodies or "carrier" not in bodies:
        return None
    count = max(max(numbers), 2)
    # neighbours must not touch: 2 (1 + r) sin(π/N) > 2.3 r
    sine = np.sin(np.pi / count)
    planet = float(min(0.9, 2 * sine / (2.3 - 2 * sine) if sine < 1.1 else 0.9))
    centre = 1.0 + planet
    teeth = 16
    layout = [GearBody("carrier", 0, 0, centre, 0)]
    if "ring" in bodies:
        layout.append(GearBody("ring", 0, 0, 1 + 2 * planet, round(teeth * (1 + 2 * planet))))
    layout.append(GearBody("sun", 0, 0, 1.0, teeth))
    for n in range(1, max(numbers) + 1):
        psi = 2 * np.pi * (n - 1) / max(numbers)
        layout.append(
            GearBody(
                f"planet{n}",
                centre * float(np.cos(psi)),
                centre * float(np.sin(psi)),
                planet,
                max(round(teeth * planet), 6),
                psi,
            )
        )
    return GearLayout(tuple(layout), 1 + 2 * planet + (0.75 if "ring" in bodies else 0.45))


def torsional_layout(points: Sequence[str]) -> GearLayout | None:
    """Layout of a set whose bodies only turn, inside a ring that is fixed; None as in `gear_layout`."""
    layout = gear_layout((*points, "ring.u"))
    return None if layout is None else replace(layout, torsional=True)


def motions(layout: GearLayout, values: Mapping[str, complex]) -> dict[str, Motion]:
    """Motion of every body from the shape's entries; NaN entries and absent DOFs count as missing.

    A planet's x and y come from themselves, or else from its zeta and eta.
    """
    known = {k: v for k, v in values.items() if np.isfinite(v)}
    if layout.torsional:
        return {body.name: _turning(body, known) for body in layout.bodies}
    result = {}
    for body in layout.bodies:
        b = body.name
        x, y = known.get(f"{b}.x"), known.get(f"{b}.y")
        if (x is None or y is None) and _PLANET.match(b):
            zeta, eta = known.get(f"{b}.zeta"), known.get(f"{b}.eta")
            c, s = np.cos(body.psi), np.sin(body.psi)
            if zeta is not None and eta is not None:
                x, y = c * zeta - s * eta, s * zeta + c * eta
            elif (zeta is not None or eta is not None) and x is None and y is None:
                # one direction only: the body is drawn moving along it
                x, y = (c * zeta, s * zeta) if zeta is not None else (-s * (eta or 0), c * (eta or 0))
                other = "eta" if zeta is not None else "zeta"
                u = known.get(f"{b}.u")
                result[b] = Motion(x, y, u or 0, (other,) if u is not None else (other, "u"))
                continue
        u = known.get(f"{b}.u")
        missing = tuple(d for d, v in (("x", x), ("y", y), ("u", u)) if v is None)
        result[b] = Motion(x or 0, y or 0, u or 0, missing)
    return result


def _turning(body: GearBody, known: Mapping[str, complex]) -> Motion:
    """Motion of a body of a torsional set."""
    u = known.get(f"{body.name}.u")
    x: complex = 0.0
    y: complex = 0.0
    if _PLANET.match(body.name):
        carried = known.get("carrier.u", 0.0)
        x, y = -np.sin(body.psi) * carried, np.cos(body.psi) * carried
    missing = ("u",) if u is None and body.name != "ring" else ()
    return Motion(x, y, u or 0, missing)


def missing_words(moved: Mapping[str, Motion]) -> str:
    """What is not measured, in a few words; bodies that lack the same are named together."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, motion in moved.items():
        if motion.missing:
            groups.setdefault(motion.missing, []).append(name)
    if not groups:
        return ""
    every = len(moved)
    parts = [
        f"{', '.join(lacks)} of {'all bodies' if len(names) == every else ', '.join(names)}"
        for lacks, names in groups.items()
    ]
    return "not measured: " + "; ".join(parts)


def displaced(body: GearBody, motion: Motion, scale: float, phase: float = 0.0) -> tuple[float, float, float]:
    """Centre and rotation (rad) of a body at a phase of the cycle."""
    turn = np.exp(1j * phase)
    return (
        body.x + scale * float((motion.x * turn).real),
        body.y + scale * float((motion.y * turn).real),
        scale * float((motion.u * turn).real) / body.radius,
    )


def outline(body: GearBody, samples: int = 6) -> NDArray[np.float64]:
    """Closed outline of a gear about its own centre, (n, 2): a circle with rounded teeth."""
    if body.teeth == 0:
        angle = np.linspace(0, 2 * np.pi, 97)
        return np.column_stack([np.cos(angle), np.sin(angle)]) * body.radius
    angle = np.linspace(0, 2 * np.pi, body.teeth * samples + 1)
    wave = np.clip(1.6 * np.cos(body.teeth * angle), -1, 1)
    r = body.radius * (1 if body.name == "ring" else 0.965) + 0.05 * wave
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


@dataclass(frozen=True)
class ShapePair:
    """A measured shape, turned to be as real as can be, and the model's beside it in the same scale.

    Both have a largest measured entry of about 1. `model` is None without a partner.
    """

    measured: dict[str, complex]
    std: dict[str, float]
    model: dict[str, complex] | None
    model_frequency_hz: float
    combined: bool


def shape_pair(configuration: ConfigurationResults, index: int) -> ShapePair:
    """Shapes of one measured mode and of its model mode, at DOF names without sign.

    In a close group any mixture of the group's shapes is a shape too: then the mixture that comes closest
    to the measured shape is shown.
    """
    modal = configuration.modal
    assert modal is not None
    mode = modal.modes[index]
    points = [d.point for d in modal.dofs]
    turned, _ = real_shape(mode.shape)
    peak = float(np.nanmax(np.abs(turned), initial=0.0)) or 1.0
    turned = turned / peak
    measured = dict(zip(points, (complex(v) for v in turned), strict=True))
    std = dict(zip(points, (float(s) / peak for s in mode.shape_std), strict=True))
    pairing, system = configuration.pairing, configuration.system
    pair = next((p for p in pairing.pairs if p.measured == index), None) if pairing else None
    if pair is None or pairing is None or system is None:
        return ShapePair(measured, std, None, float("nan"), False)
    group = [p.model for p in pairing.pairs if p.group >= 0 and p.group == pair.group] or [pair.model]
    rows = sensor_matrix(system, points)
    shapes = np.array([pairing.model_modes[j].shape for j in group])
    at_points = shapes @ rows.T
    common = np.isfinite(turned) & np.isfinite(at_points).all(axis=0)
    weights, *_ = np.linalg.lstsq(at_points[:, common].T, turned[common].real, rcond=None)
    combined = weights @ shapes
    everywhere = list(dict.fromkeys([*system.dofs, *system.sensors]))
    values = sensor_matrix(system, everywhere) @ combined
    model = dict(zip(everywhere, (complex(v) for v in values), strict=True))
    return ShapePair(measured, std, model, pair.model_frequency_hz, len(group) > 1)


def sensor_matrix(system: LinearSystem, points: Sequence[str]) -> NDArray[np.float64]:
    """Rows that turn the system's coordinates into what sensors at `points` read; NaN where it has none."""
    at = {d: i for i, d in enumerate(system.dofs)}
    rows = np.full((len(points), len(system.dofs)), np.nan)
    for r, point in enumerate(points):
        if point in at:
            rows[r] = 0.0
            rows[r, at[point]] = 1.0
        elif point in system.sensors:
            rows[r] = system.sensors[point]
    return rows


def drawing_scale(layout: GearLayout, moved: Mapping[str, Motion], share: float = 0.16) -> float:
    """Scale at which the largest motion of any body is `share` of the drawing's radius."""
    largest = max((max(abs(m.x), abs(m.y), abs(m.u)) for m in moved.values()), default=0.0)
    return share * layout.reach / largest if largest > 0 else 0.0


def layout_of(configuration: ConfigurationResults) -> GearLayout | None:
    """Layout from the model's DOFs, or else from the measured ones."""
    if configuration.system is not None:
        dofs = configuration.system.dofs
        only_turn = all(d.endswith(".u") for d in dofs)
        return torsional_layout(dofs) if only_turn else gear_layout(dofs)
    if configuration.modal is not None:
        return gear_layout(d.point for d in configuration.modal.dofs)
    return None


def body_of(point: str) -> str:
    """Body of a DOF written as text, with or without sign."""
    return Dof.parse(point).body
