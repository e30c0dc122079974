"""Moving shapes for the HTML report: inline SVG whose bodies a few lines of script set in motion."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from ema_pipeline.number_text import format_percent, format_value
from ema_pipeline.report.name_text import slug
from ema_pipeline.report.results import ConfigurationResults
from ema_pipeline.report.shapes import drawing_for, missing_words, shape_pair
from ema_pipeline.rigs.drawing import Body, Drawing, Motion

UNITS = 100.0
"""Units of the page per unit of a drawing."""

_SCALE_SHARE = 0.14


@dataclass(frozen=True)
class MovingBody:
    """One body: which outline, its place at phase 0 and at rest, whether its turn is known, length of its spoke.

    `rim` is the outer radius of a ring, `arms` the ends of a body's arms.
    """

    form: str
    fill: str
    outline_id: str
    transform: str
    rest: str
    turns: bool
    spoke: float
    rim: float
    arms: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class MovingShape:
    """One drawing; `motion` is JSON, per body [cx, cy, Re x, Im x, Re y, Im y, Re φ, Im φ], φ in degrees."""

    label: str
    bodies: tuple[MovingBody, ...]
    motion: str


@dataclass(frozen=True)
class MovingMode:
    """A mode: the measured shape and, where it has a partner, the model's."""

    title: str
    damping: str
    drawings: tuple[MovingShape, ...]
    remark: str


@dataclass(frozen=True)
class MovingShapes:
    """All modes of a configuration, with the outlines (id → SVG path) that their drawings share."""

    outlines: dict[str, str]
    view_box: str
    modes: tuple[MovingMode, ...]
    missing: str


def moving_shapes(configuration: ConfigurationResults) -> MovingShapes | None:
    """Drawings of all modes; None where the rig has no drawing or no mode was found."""
    drawing = drawing_for(configuration)
    modal = configuration.modal
    if drawing is None or modal is None or not modal.modes:
        return None
    stem = slug(configuration.name)
    outlines = {f"{stem}-{body.like}": outline_path(body) for body in drawing.bodies}
    modes, lacks = [], ""
    for index, mode in enumerate(modal.modes):
        pair = shape_pair(configuration, index)
        moved = drawing.motions(pair.measured)
        lacks = missing_words(moved)
        scale = drawing.scale(moved, _SCALE_SHARE)
        drawings = [_drawn(stem, drawing, moved, scale, f"Measured shape of mode {index + 1}")]
        remark = "no model partner"
        if pair.model is not None:
            theirs = drawing.motions(pair.model)
            drawings.append(_drawn(stem, drawing, theirs, scale, f"Model shape beside mode {index + 1}"))
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
    reach = 1.12 * drawing.reach * UNITS
    box = " ".join(f"{v:.0f}" for v in (-reach, -reach, 2 * reach, 2 * reach))
    return MovingShapes(outlines, box, tuple(modes), lacks)


def _drawn(stem: str, drawing: Drawing, moved: dict[str, Motion], scale: float, label: str) -> MovingShape:
    bodies, numbers = [], []
    for body in drawing.bodies:
        motion = moved[body.name]
        x, y, turn = body.displaced(motion, scale)
        place = f"translate({in_units(x):g} {in_units(y):g}) rotate({np.rad2deg(turn):.2f})"
        bodies.append(
            MovingBody(
                body.form,
                body.fill,
                f"{stem}-{body.like}",
                place,
                f"translate({in_units(body.x):g} {in_units(body.y):g})",
                "u" not in motion.missing,
                in_units(0.85 * body.radius),
                in_units(body.radius + 0.35),
                tuple((in_units(x), in_units(y)) for x, y in body.arms),
            )
        )
        u = complex(motion.u) * scale / body.radius * 180 / np.pi
        mx, my = complex(motion.x) * scale * UNITS, complex(motion.y) * scale * UNITS
        row = (body.x * UNITS, body.y * UNITS, mx.real, mx.imag, my.real, my.imag, u.real, u.imag)
        numbers.append([round(float(v), 2) for v in row])
    return MovingShape(label, tuple(bodies), json.dumps(numbers, separators=(",", ":")))


def outline_path(body: Body) -> str:
    """Outline of a body about its own centre, as an SVG path."""
    points = body.outline(samples=4 if body.teeth else 1) * UNITS
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points[:-1]) + "Z"


def in_units(value: float) -> float:
    """A length of the drawing in `UNITS`, rounded for SVG."""
    return round(float(value) * UNITS, 2)
