"""Moving planetary gears for the HTML report: inline SVG whose bodies a few lines of script set in motion."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from ema_pipeline.report.numbers import format_percent, format_value, slug
from ema_pipeline.report.planetary import (
    FILLS,
    GearBody,
    GearLayout,
    Motion,
    displaced,
    drawing_scale,
    layout_of,
    missing_words,
    motions,
    outline,
    shape_pair,
)
from ema_pipeline.report.results import ConfigurationResults

UNITS = 100.0
"""Drawing units per radius of the sun."""

_SCALE_SHARE = 0.14


@dataclass(frozen=True)
class MovingBody:
    """One body: which outline, its place at phase 0 and at rest, whether its turn is known, length of its spoke."""

    kind: str
    outline_id: str
    transform: str
    rest: str
    turns: bool
    spoke: float


@dataclass(frozen=True)
class MovingGear:
    """One drawing; `motion` is JSON, per body [cx, cy, Re x, Im x, Re y, Im y, Re φ, Im φ], φ in degrees."""

    label: str
    bodies: tuple[MovingBody, ...]
    motion: str


@dataclass(frozen=True)
class MovingMode:
    """A mode: the measured shape and, where it has a partner, the model's."""

    title: str
    damping: str
    drawings: tuple[MovingGear, ...]
    remark: str


@dataclass(frozen=True)
class MovingGears:
    """All modes of a configuration, with the outlines (id → SVG path) that their drawings share."""

    outlines: dict[str, str]
    view_box: str
    ring_radius: float
    spokes: tuple[tuple[float, float], ...]
    modes: tuple[MovingMode, ...]
    missing: str


def moving_gears(configuration: ConfigurationResults) -> MovingGears | None:
    """Drawings of all modes; None where the structure is no planetary gear or no mode was found."""
    layout = layout_of(configuration)
    modal = configuration.modal
    if layout is None or modal is None or not modal.modes:
        return None
    stem = slug(configuration.name)
    outlines = {f"{stem}-{kind}": outline_path(body) for kind, body in _kinds(layout).items()}
    modes, lacks = [], ""
    for index, mode in enumerate(modal.modes):
        pair = shape_pair(configuration, index)
        moved = motions(layout, pair.measured)
        lacks = missing_words(moved)
        scale = drawing_scale(layout, moved, _SCALE_SHARE)
        drawings = [_drawing(stem, layout, moved, scale, f"Measured shape of mode {index + 1}")]
        remark = "no model partner"
        if pair.model is not None:
            theirs = motions(layout, pair.model)
            drawings.append(_drawing(stem, layout, theirs, scale, f"Model shape beside mode {index + 1}"))
            remark = f"model {pair.model_frequency_hz:.5g} Hz" + (
                ", mixture of its close group" if pair.combined else ""
            )
        modes.append(
            MovingMode(
                f"Mode {index + 1}: {format_value(mode.frequency_hz, mode.frequency_std_hz, 'Hz')}",
                format_percent(mode.damping_ratio, mode.damping_std),
                tuple(drawings),
                remark,
            )
        )
    reach = 1.12 * layout.reach * UNITS
    ring = next((b.radius for b in layout.bodies if b.name == "ring"), 0.0)
    planets = tuple((_n(b.x), _n(b.y)) for b in layout.bodies if b.name.startswith("planet"))
    box = " ".join(f"{v:.0f}" for v in (-reach, -reach, 2 * reach, 2 * reach))
    return MovingGears(outlines, box, _n(ring + 0.35) if ring else 0.0, planets, tuple(modes), lacks)


def fill_of(kind: str) -> str:
    """Fill colour of a kind of body, the same as in the figures."""
    return FILLS[kind]


def _kinds(layout: GearLayout) -> dict[str, GearBody]:
    return {_kind(b): b for b in layout.bodies}


def _kind(body: GearBody) -> str:
    return body.name.rstrip("0123456789")


def _drawing(stem: str, layout: GearLayout, moved: dict[str, Motion], scale: float, label: str) -> MovingGear:
    bodies, numbers = [], []
    for body in layout.bodies:
        motion = moved[body.name]
        x, y, turn = displaced(body, motion, scale)
        place = f"translate({_n(x):g} {_n(y):g}) rotate({np.rad2deg(turn):.2f})"
        bodies.append(
            MovingBody(
                _kind(body),
                f"{stem}-{_kind(body)}",
                place,
                f"translate({_n(body.x):g} {_n(body.y):g})",
                "u" not in motion.missing,
                _n(0.85 * body.radius),
            )
        )
        u = complex(motion.u) * scale / body.radius * 180 / np.pi
        mx, my = complex(motion.x) * scale * UNITS, complex(motion.y) * scale * UNITS
        row = (body.x * UNITS, body.y * UNITS, mx.real, mx.imag, my.real, my.imag, u.real, u.imag)
        numbers.append([round(float(v), 2) for v in row])
    return MovingGear(label, tuple(bodies), json.dumps(numbers, separators=(",", ":")))


def outline_path(body: GearBody) -> str:
    """Outline of a body about its own centre, as an SVG path."""
    points = outline(body, samples=4 if body.teeth else 1) * UNITS
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points[:-1]) + "Z"


def _n(value: float) -> float:
    return round(float(value) * UNITS, 2)
