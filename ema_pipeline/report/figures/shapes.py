"""Mode shapes: a planetary gear in its plane, or stems over the DOFs of any other structure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from ema_pipeline.report.planetary import (
    FILLS,
    GearLayout,
    Motion,
    displaced,
    drawing_scale,
    missing_words,
    motions,
    outline,
    shape_pair,
)
from ema_pipeline.report.results import ConfigurationResults
from ema_pipeline.report.style import GREY, MEASURED, MODEL, margins, new_figure, note, styled

GEAR_MODES_PER_SHEET = 4
STEM_MODES_PER_SHEET = 4
_DOF_LABELS_UP_TO = 34


@styled
def gear_shapes(configuration: ConfigurationResults, layout: GearLayout, indices: Sequence[int]) -> Figure:
    """Measured shapes of up to four modes as a moved gear set, each with the model's shape beside it."""
    modal = configuration.modal
    assert modal is not None
    rows = -(-len(indices) // 2)
    figure = new_figure(0.35 + 2.2 * rows)
    grid = figure.add_gridspec(
        rows, 4, hspace=0.3, wspace=0.02, **margins(figure, left=0.05, right=0.05, bottom=0.3, top=0.4)
    )
    lacks = ""
    for k, index in enumerate(indices):
        pair = shape_pair(configuration, index)
        mode = modal.modes[index]
        left = figure.add_subplot(grid[k // 2, 2 * (k % 2)])
        right = figure.add_subplot(grid[k // 2, 2 * (k % 2) + 1])
        moved = motions(layout, pair.measured)
        lacks = missing_words(moved)
        scale = drawing_scale(layout, moved)
        draw_gear(left, layout, moved, scale)
        left.set_title(f"mode {index + 1}: {mode.frequency_hz:.5g} Hz\nmeasured", fontsize=7.2)
        if pair.model is None:
            empty(right)
            note(right, "no model shape", fontsize=7)
            continue
        draw_gear(right, layout, motions(layout, pair.model), scale)
        mix = " (mixture of its group)" if pair.combined else ""
        right.set_title(
            f"model: {pair.model_frequency_hz:.5g} Hz\n{mix.strip() or 'same scale'}", fontsize=7.2
        )
    words = "dashed: at rest; solid: moved, exaggerated; spoke: turning, where known"
    figure.text(
        0.5,
        0.08 / figure.get_size_inches()[1],
        f"{words}. {lacks}",
        ha="center",
        va="bottom",
        fontsize=6.3,
        color=GREY,
    )
    return figure


def empty(ax: Axes) -> None:
    """Axes for a drawing: equal scales, nothing but the drawing."""
    ax.set_aspect("equal")
    ax.set_axis_off()


def draw_gear(
    ax: Axes, layout: GearLayout, moved: dict[str, Motion], scale: float, fills: dict[str, str] | None = None
) -> None:
    """Draw the gear set at rest (dashed) and moved (solid); bodies with missing DOFs are drawn pale."""
    empty(ax)
    reach = 1.12 * layout.reach
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    planets = [b for b in layout.bodies if b.name.startswith("planet")]
    for body in layout.bodies:
        x, y, turn = displaced(body, moved[body.name], scale)
        place = Affine2D().rotate(turn).translate(x, y) + ax.transData
        rest = Affine2D().translate(body.x, body.y) + ax.transData
        kind = body.name.rstrip("0123456789")
        fill = (fills or {}).get(body.name, FILLS[kind])
        everything = 1 if layout.torsional else 3
        unknown = len(moved[body.name].missing) == everything and fills is None
        if kind == "carrier":
            circle = outline(body)
            ax.add_artist(Polygon(circle, fill=False, ec="#a0a0a0", lw=0.5, ls=(0, (3, 2)), transform=rest))
            ax.add_artist(
                Polygon(circle, fill=False, ec="#d9a878" if fills is None else fill, lw=3.2, transform=place)
            )
            for planet in planets:
                ax.add_artist(
                    Line2D(
                        [0, planet.x],
                        [0, planet.y],
                        color="#d9a878" if fills is None else fill,
                        lw=3.2,
                        transform=place,
                    )
                )
            continue
        teeth = outline(body)
        ax.add_artist(
            Polygon(teeth, fill=False, ec="#8a8a8a", lw=0.5, ls=(0, (3, 2)), transform=rest, zorder=1.5)
        )
        if kind == "ring":
            angle = np.linspace(0, 2 * np.pi, 121)
            outer = (body.radius + 0.35) * np.column_stack([np.cos(angle), np.sin(angle)])
            ax.add_artist(
                Polygon(outer, fc=fill, ec="#333333", lw=0.7, transform=place, zorder=-2, alpha=0.9)
            )
            ax.add_artist(Polygon(teeth, fc="white", ec="#333333", lw=0.7, transform=place, zorder=-1))
        else:
            ax.add_artist(
                Polygon(
                    teeth,
                    fc="none" if unknown else fill,
                    ec="#333333",
                    lw=0.7,
                    alpha=0.9,
                    transform=place,
                    zorder=2,
                )
            )
            ax.plot(x, y, "o", color="#333333", ms=1.8, zorder=4)
        if "u" in moved[body.name].missing:
            continue  # a spoke would claim that the body does not turn
        inner = 0.0 if kind != "ring" else body.radius + 0.05
        end = body.radius * 0.9 if kind != "ring" else body.radius + 0.33
        ax.add_artist(Line2D([inner, end], [0, 0], color=MODEL, lw=1.4, transform=place, zorder=4))
        ax.add_artist(
            Line2D([inner, end], [0, 0], color="#8a8a8a", lw=0.6, ls=(0, (3, 2)), transform=rest, zorder=3)
        )


@styled
def stem_shapes(configuration: ConfigurationResults, indices: Sequence[int]) -> Figure:
    """Shapes over the DOFs, grouped by body: real part after the best rotation, with error bars of ±1σ."""
    modal = configuration.modal
    assert modal is not None
    order = sorted(
        range(len(modal.dofs)), key=lambda i: (_natural(modal.dofs[i].body), modal.dofs[i].direction)
    )
    names = [modal.dofs[i].point for i in order]
    bodies = [modal.dofs[i].body for i in order]
    at = np.arange(len(names))
    figure = new_figure(0.95 + 1.45 * len(indices))
    grid = figure.add_gridspec(
        len(indices), 1, hspace=0.42, **margins(figure, left=0.55, bottom=0.75, top=0.5)
    )
    firsts = [k for k in range(len(bodies)) if k == 0 or bodies[k] != bodies[k - 1]]
    for row, index in enumerate(indices):
        ax = figure.add_subplot(grid[row])
        pair = shape_pair(configuration, index)
        value = np.array([pair.measured[n].real for n in names])
        std = np.nan_to_num(np.array([pair.std[n] for n in names]))
        ax.vlines(at, 0, value, color=MEASURED, lw=0.9)
        ax.errorbar(
            at, value, yerr=std, fmt="o", ms=2.6, color=MEASURED, elinewidth=0.5, label="measured, ±1σ"
        )
        if pair.model is not None:
            other = np.array([pair.model.get(n, complex(np.nan)).real for n in names])
            ax.plot(at + 0.2, other, "x", color=MODEL, ms=4, label=f"model, {pair.model_frequency_hz:.5g} Hz")
        for k, start in enumerate(firsts):
            end = (firsts[k + 1] if k + 1 < len(firsts) else len(names)) - 0.5
            if k % 2 == 0:
                ax.axvspan(start - 0.5, end, color="#f3f3f3", lw=0, zorder=0)
        ax.axhline(0, color="black", lw=0.6)
        ax.set_xlim(-0.7, len(names) - 0.3)
        ax.set_ylim(-1.25, 1.25)
        ax.set_title(f"mode {index + 1}: {modal.modes[index].frequency_hz:.5g} Hz", loc="left", pad=3)
        ax.set_ylabel("shape, 1")
        ax.grid(False, axis="x")
        if row == 0:
            ax.legend(loc="lower right", bbox_to_anchor=(1, 1.0), ncols=2, frameon=False, borderpad=0)
        if row < len(indices) - 1:
            ax.tick_params(labelbottom=False)
        elif len(names) <= _DOF_LABELS_UP_TO:
            ax.set_xticks(at, names, rotation=90, fontsize=6)
        else:
            step = -(-len(firsts) // _DOF_LABELS_UP_TO)
            ax.set_xticks(
                [firsts[k] for k in range(0, len(firsts), step)],
                [bodies[firsts[k]] for k in range(0, len(firsts), step)],
                rotation=90,
                fontsize=6,
            )
    return figure


def _natural(text: str) -> tuple[str, int]:
    """Sort key that puts point2 before point10."""
    head = text.rstrip("0123456789")
    return head, int(text[len(head) :] or 0)
