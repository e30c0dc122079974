"""Force-displacement loops, measured and modelled: the figures, and the numbers that fill them."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.layouts import column
from numpy.typing import NDArray

from ema_pipeline.loops.types import Loop, LoopModel
from ema_pipeline.report.diagnosis import label_words
from ema_pipeline.report.interactive.theme import (
    AFTER,
    BEFORE,
    INK,
    INK_TAG,
    hover,
    new_figure,
    place_legend,
    source,
)
from ema_pipeline.report.results import LoopResults

POINTS = 400
"""Points of a loop that are kept at most."""

DIGITS = 5


def loop_model_names(found: LoopResults) -> list[str]:
    """Names of the models that are compared."""
    names = ["linear spring"]
    if len(found.models) > 1:
        names.append("with " + " + ".join(map(label_words, found.models[-1].effects)))
    return names


def loops_data(found: LoopResults | None) -> list[dict[str, Any]]:
    """One entry per loop: its points in the order of the cycle, from the lowest displacement on.

    ``x`` in mm, ``measured`` and ``models`` (one list per model) in N, ``share`` of the cycle that has passed.
    """
    if found is None:
        return []
    return [_one(k, loop, found.compared) for k, loop in enumerate(found.loops)]


def _one(k: int, loop: Loop, models: tuple[LoopModel, ...]) -> dict[str, Any]:
    passed = (loop.phase - loop.phase[int(np.argmin(loop.displacement))]) % 1.0
    order = np.argsort(passed)[:: max(1, -(-len(passed) // POINTS))]
    return {
        "name": loop.name,
        "share": _rounded(passed[order]),
        "x": _rounded(1e3 * loop.displacement[order]),
        "measured": _rounded(loop.force[order]),
        "models": [_rounded(m.fits[k].force[order]) for m in models],
    }


def loss_data(found: LoopResults | None) -> list[dict[str, Any]]:
    """Loss factors with their standard deviations, one line per amplitude of a configuration."""
    if found is None:
        return []
    lines: dict[str, list[list[float]]] = {}
    for name, one in found.isolators.items():
        for p in one.loss:
            where = f"{name}, " if len(found.isolators) > 1 else ""
            lines.setdefault(f"{where}{1e3 * p.amplitude_m:.3g} mm", []).append(
                [p.frequency_hz, p.value, p.std]
            )
    return [{"name": name, "points": sorted(points)} for name, points in lines.items()]


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{v:.{DIGITS}g}") for v in values]


def loops_figure() -> Any:
    """Force over displacement, and below it what the models leave of the force along the cycle."""
    curves = source("loops.curves", "x", "measured", "before", "after")
    made = new_figure("displacement, mm", "force, N", 400)
    line = made.line(
        "x", "measured", source=curves, color=INK, line_width=3, alpha=0.55, legend_label="measured"
    )
    line.glyph.tags = [INK_TAG]
    made.line(
        "x", "before", source=curves, color=BEFORE, line_dash="dashed", line_width=1.6,
        legend_label="linear spring", name="loops.before",
    )  # fmt: skip
    made.line(
        "x",
        "after",
        source=curves,
        color=AFTER,
        line_width=1.6,
        legend_label="with effects",
        name="loops.after",
    )
    hover(made, [line], ("displacement", "@x{0.000} mm"), ("force", "@measured{0.0} N"))
    place_legend(made)
    left = source("loops.left", "share", "before", "after")
    below = new_figure("share of the cycle", "measured − model, N", 220)
    below.hspan([0], line_color=INK)
    below.line("share", "before", source=left, color=BEFORE, line_dash="dashed", line_width=1.4)
    below.line("share", "after", source=left, color=AFTER, line_width=1.4)
    return column(made, below, sizing_mode="stretch_width")


def loss_figure() -> Any:
    """Loss factor over frequency."""
    lines = source("loss.lines", "xs", "ys", "text", "color")
    made = new_figure("frequency, Hz", "loss factor η", 300)
    curves = made.multi_line("xs", "ys", source=lines, line_color="color", line_width=2)
    dots = source("loss.points", "x", "y", "low", "high", "text", "color")
    made.segment("x", "low", "x", "high", source=dots, color="color")
    points = made.scatter("x", "y", source=dots, color="color", size=7)
    hover(made, [curves, points], ("amplitude", "@text"))
    return made
