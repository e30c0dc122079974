"""Where model and measurement differ: per mode, per DOF and per FRF band, in units of the uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ema_pipeline.correlate.types import BandDifference, DofDifference, ModeDifference
from ema_pipeline.report.figures.shapes import draw_rig
from ema_pipeline.report.shapes import body_of
from ema_pipeline.report.style import (
    BLUE,
    GREEN,
    LIGHT,
    VERMILLION,
    margins,
    new_figure,
    styled,
)
from ema_pipeline.rigs.drawing import Drawing

FRF_ROWS = 40
LEVELS = (0, 1, 2, 3, 5, 10, 20, 50)
_LINEAR = 3.0


@styled
def mode_differences(modes: Sequence[ModeDifference]) -> Figure:
    """Frequency, damping and shape difference of every pair in units of its uncertainty."""
    per_panel = 24
    groups: list[tuple[str, list[ModeDifference]]] = []
    for configuration in dict.fromkeys(m.configuration for m in modes):
        mine = [m for m in modes if m.configuration == configuration]
        parts = max(1, -(-len(mine) // per_panel))
        size = -(-len(mine) // parts)
        groups += [(configuration, mine[k : k + size]) for k in range(0, len(mine), size)]
    figure = new_figure(0.55 + 2.45 * len(groups))
    grid = figure.add_gridspec(len(groups), 1, hspace=0.75, **margins(figure, top=0.55, bottom=0.75))
    series = (
        ("frequency", "frequency_z", BLUE, ""),
        ("damping ratio", "damping_z", GREEN, "///"),
        ("shape", "shape_z", VERMILLION, "..."),
    )
    limit = 1.15 * max(
        [5.0, *(abs(v) for m in modes for v in (m.frequency_z, m.damping_z, m.shape_z) if np.isfinite(v))]
    )
    for k, (configuration, mine) in enumerate(groups):
        ax = figure.add_subplot(grid[k])
        at = np.arange(len(mine))
        ax.axhspan(-2, 2, color="#efefef", lw=0, zorder=0)
        for i, (label, field, color, hatch) in enumerate(series):
            z = np.array([getattr(m, field) for m in mine], dtype=float)
            ax.bar(
                at + 0.27 * (i - 1),
                np.nan_to_num(z),
                0.25,
                color=color,
                hatch=hatch,
                ec="white",
                lw=0.3,
                label=label,
                zorder=2,
            )
        ax.axhline(0, color="black", lw=0.7)
        sigma_axis(ax, limit)
        ax.set_xlim(-0.7, len(mine) - 0.3)
        ax.set_xticks(
            at, [f"{m.measured + 1}: {m.measured_frequency_hz:.4g}" for m in mine], rotation=90, fontsize=6.2
        )
        ax.grid(False, axis="x")
        ax.set_title(configuration, loc="left")
        ax.set_ylabel("(measured − model)/σ, 1")
        ax.set_xlabel("measured mode, Hz")
    handles = [Patch(fc=c, hatch=h, ec="white", label=label) for label, _, c, h in series]
    figure.legend(
        handles=[*handles, Patch(fc="#efefef", label="within ±2σ")], loc="upper right", ncols=4, frameon=False
    )
    return figure


@styled
def dof_differences(dofs: Sequence[DofDifference], drawing: Drawing | None = None) -> Figure:
    """Shape difference per DOF in units of its uncertainty; on the rig's drawing too where it has one."""
    shown = sorted(dofs, key=lambda d: -np.nan_to_num(d.z))[:FRF_ROWS]
    keep = [d for d in dofs if d in shown]
    share = 0.58 if drawing else 1.0
    figure = new_figure(max(0.95 + 0.155 * len(keep), 2.9))
    width, height = figure.get_size_inches()
    left = 1.35
    several = len({d.configuration for d in dofs}) > 1
    ax = figure.add_axes(
        (left / width, 0.5 / height, (share * width - left - 0.2) / width, (height - 0.85) / height)
    )
    at = np.arange(len(keep))
    z = np.array([d.z for d in keep], dtype=float)
    ax.axvspan(0, 2, color="#efefef", lw=0)
    ax.hlines(at, 0, np.nan_to_num(z), color=[VERMILLION if v > 3 else BLUE for v in z], lw=1.4)
    for marker, color, where in (("o", BLUE, z <= 3), ("D", VERMILLION, z > 3)):
        ax.plot(z[where], at[where], marker, color=color, ms=4)
    ax.set_yticks(at, [f"{d.dof} ({d.configuration})" if several else d.dof for d in keep], fontsize=6.5)
    ax.set_ylim(len(keep) - 0.4, -0.6)
    ax.set_xlim(0, 1.1 * max(5.0, float(np.nanmax(z, initial=0.0))))
    ax.set_xlabel("shape difference / σ, root mean square, 1")
    ax.grid(False, axis="y")
    ax.set_title("Per DOF" + (f" (worst {len(keep)} of {len(dofs)})" if len(keep) < len(dofs) else ""))
    if drawing is not None:
        rig = figure.add_axes((share + 0.01, 0.24, 0.97 - share, 0.68))
        worst = worst_per_body(dofs)
        norm, colours = severity()
        fills = {
            b.name: to_hex(colours(norm(worst[b.name]))) if b.name in worst else "#ffffff"
            for b in drawing.bodies
        }
        draw_rig(rig, drawing, drawing.at_rest(), 0.0, fills)
        rig.set_title("Largest per body (white: not measured)")
        for b in drawing.bodies:
            if b.name not in worst:
                continue
            x, y = b.label_at
            rig.text(
                x,
                y,
                f"{worst[b.name]:.1f}",
                ha="center",
                va="center",
                fontsize=7,
                zorder=6,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
            )
        bar = figure.add_axes((share + 0.06, 0.14, 0.87 - share, 0.12 / height))
        figure.colorbar(ScalarMappable(norm, colours), cax=bar, orientation="horizontal").set_label(
            "shape difference / σ, 1"
        )
    return figure


@styled
def band_differences(bands: Sequence[BandDifference], configuration: str) -> Figure:
    """FRF difference per band in units of its uncertainty, as a map; of many FRFs only the worst."""
    mine = [b for b in bands if b.configuration == configuration]
    pairs = list(dict.fromkeys((b.output, b.input) for b in mine))
    edges = sorted({b.low_hz for b in mine} | {b.high_hz for b in mine})
    columns = sorted({(b.low_hz, b.high_hz) for b in mine})
    values = np.full((len(pairs), len(columns)), np.nan)
    for b in mine:
        values[pairs.index((b.output, b.input)), columns.index((b.low_hz, b.high_hz))] = b.z
    total = len(pairs)
    if total > FRF_ROWS:
        size = np.nan_to_num(np.sqrt(np.nanmean(np.where(np.isfinite(values), values, 0) ** 2, axis=1)))
        rows = np.sort(np.argsort(-size)[:FRF_ROWS])
        values, pairs = values[rows], [pairs[r] for r in rows]
    figure = new_figure(0.95 + max(0.145 * len(pairs), 0.8))
    grid = figure.add_gridspec(1, 1, **margins(figure, left=1.5, right=0.95, bottom=0.55, top=0.35))
    ax = figure.add_subplot(grid[0])
    norm, colours = severity()
    image = ax.imshow(values, norm=norm, cmap=colours, aspect="auto", interpolation="nearest")
    ax.grid(False)
    ax.set_yticks(range(len(pairs)), [f"{o} ← {i}" for o, i in pairs], fontsize=6)
    if len(edges) == len(columns) + 1:
        ax.set_xticks(np.arange(len(edges)) - 0.5, [f"{e:.3g}" if e < 1000 else f"{e:.0f}" for e in edges])
    else:
        ax.set_xticks(range(len(columns)), [f"{a:.3g}–{b:.3g}" for a, b in columns], rotation=45)
    step = max(1, len(ax.get_xticks()) // 14)
    ax.set_xticks(ax.get_xticks()[::step], [t.get_text() for t in ax.get_xticklabels()][::step])
    ax.set_xlabel("frequency, Hz")
    some = f" (worst {len(pairs)} of {total})" if len(pairs) < total else ""
    ax.set_title(f"{configuration}: FRF difference per band{some}")
    width = figure.get_size_inches()[0]
    box = ax.get_position()
    bar = figure.add_axes((box.x1 + 0.12 / width, box.y0, 0.13 / width, box.height))
    figure.colorbar(image, cax=bar).set_label("difference / σ, 1")
    return figure


def sigma_axis(ax: Axes, limit: float) -> None:
    """Axis in units of σ: linear to ±3, logarithmic beyond, with plain numbers."""
    if limit <= 12:
        ax.set_ylim(-limit, limit)
        return
    ax.set_yscale("symlog", linthresh=_LINEAR, linscale=1.0)
    steps = [t for t in (3, 10, 30, 100, 300, 1000, 3000, 10000, 100000) if t <= limit]
    ax.yaxis.set_major_locator(FixedLocator([-t for t in steps[::-1]] + [0, *steps]))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}".replace("-", "−")))
    ax.set_ylim(-limit, limit)


def worst_per_body(dofs: Sequence[DofDifference]) -> dict[str, float]:
    """Largest shape difference of every body that carries a sensor, in σ."""
    worst: dict[str, float] = {}
    for d in dofs:
        body = body_of(d.dof)
        worst[body] = max(worst.get(body, 0.0), float(np.nan_to_num(d.z)))
    return worst


def severity() -> tuple[BoundaryNorm, matplotlib.colors.Colormap]:
    """Colours of differences in σ, darker where worse."""
    colours = matplotlib.colormaps["OrRd"].with_extremes(bad=LIGHT)
    return BoundaryNorm(LEVELS, colours.N, extend="max"), colours
