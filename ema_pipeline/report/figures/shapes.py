"""Mode shapes: the rig's drawing moved, or stems over the DOFs of a rig without one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from ema_pipeline.report.results import ConfigurationResults
from ema_pipeline.report.shapes import missing_words, shape_pair
from ema_pipeline.report.style import GREY, MEASURED, MODEL, margins, new_figure, note, styled
from ema_pipeline.rigs.drawing import Drawing, Motion

DRAWN_MODES_PER_SHEET = 4
STEM_MODES_PER_SHEET = 4
_DOF_LABELS_UP_TO = 34
_ARMS = "#d9a878"
"""Colour of a body with arms, which is drawn as lines."""


@styled
def drawn_shapes(configuration: ConfigurationResults, drawing: Drawing, indices: Sequence[int]) -> Figure:
    """Measured shapes of up to four modes on the moved drawing of the rig, each with the model's shape beside it."""
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
        moved = drawing.motions(pair.measured)
        lacks = missing_words(moved)
        scale = drawing.scale(moved)
        draw_rig(left, drawing, moved, scale)
        left.set_title(f"mode {index + 1}: {mode.frequency_hz:.5g} Hz\nmeasured", fontsize=7.2)
        if pair.model is None:
            empty(right)
            note(right, "no model shape", fontsize=7)
            continue
        draw_rig(right, drawing, drawing.motions(pair.model), scale)
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


def draw_rig(
    ax: Axes, drawing: Drawing, moved: dict[str, Motion], scale: float, fills: dict[str, str] | None = None
) -> None:
    """Draw the rig at rest (dashed) and moved (solid); bodies with missing DOFs are drawn pale."""
    empty(ax)
    reach = 1.12 * drawing.reach
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    for body in drawing.bodies:
        x, y, turn = body.displaced(moved[body.name], scale)
        place = Affine2D().rotate(turn).translate(x, y) + ax.transData
        rest = Affine2D().translate(body.x, body.y) + ax.transData
        fill = (fills or {}).get(body.name, body.fill)
        unknown = len(moved[body.name].missing) == drawing.directions and fills is None
        if body.form == "arms":
            circle, color = body.outline(), _ARMS if fills is None else fill
            ax.add_artist(Polygon(circle, fill=False, ec="#a0a0a0", lw=0.5, ls=(0, (3, 2)), transform=rest))
            ax.add_artist(Polygon(circle, fill=False, ec=color, lw=3.2, transform=place))
            for x, y in body.arms:
                ax.add_artist(Line2D([0, x], [0, y], color=color, lw=3.2, transform=place))
            continue
        teeth = body.outline()
        ax.add_artist(
            Polygon(teeth, fill=False, ec="#8a8a8a", lw=0.5, ls=(0, (3, 2)), transform=rest, zorder=1.5)
        )
        if body.form == "ring":
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
        ring = body.form == "ring"
        inner = body.radius + 0.05 if ring else 0.0
        end = body.radius + 0.33 if ring else body.radius * 0.9
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
