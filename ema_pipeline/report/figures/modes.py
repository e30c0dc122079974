"""Stabilisation chart and the overview of frequencies and damping ratios."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ema_pipeline.frf.overview import cmif
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report.figures.frf import accelerance_unit
from ema_pipeline.report.shown_band import places
from ema_pipeline.report.style import (
    BLUE,
    GREY,
    MARKERS,
    SERIES,
    VERMILLION,
    frequency_axis,
    frequency_range,
    log_y,
    margins,
    mark_modes,
    new_figure,
    note,
    styled,
)

_BACKGROUND_LINES = 3000


@styled
def stabilisation_chart(modal: ModalModel, frfs: FrfSet | None) -> Figure:
    """Poles of all model orders over the CMIF; stable, unstable and chosen poles differ by marker."""
    figure = new_figure(4.2)
    grid = figure.add_gridspec(1, 1, **margins(figure, top=0.66, right=0.62, bottom=0.72))
    ax = figure.add_subplot(grid[0])
    chart = modal.chart
    modes = [m.frequency_hz for m in modal.modes]
    seen = (*places(modal), *chart.frequency_hz[chart.stable].tolist())
    low, high, log = frequency_range(modal.band_hz, modes, modal.frequency_hz, seen)
    frequency_axis(ax, low, high, log)
    if frfs is not None:
        back = ax.twinx()
        f = frfs.frequency_hz
        shown = np.flatnonzero((f >= low) & (f <= high) & (f > 0))
        shown = shown[:: max(1, shown.size // _BACKGROUND_LINES)]
        for k, row in enumerate(cmif(frfs.accelerance()[..., shown], 2)):
            back.plot(f[shown], row, color="#8a8a8a", lw=0.8, ls=("-", ":")[k], rasterized=True)
        log_y(back)
        back.grid(False)
        back.spines["right"].set_visible(True)
        back.set_ylabel(f"CMIF, {accelerance_unit(frfs)}", color=GREY)
        back.tick_params(colors=GREY)
        ax.set_zorder(back.get_zorder() + 1)
        ax.patch.set_visible(False)
    chosen = chart.selected >= 0
    stable = chart.stable & ~chosen
    other = ~chart.stable & ~chosen
    inside = (chart.frequency_hz >= low) & (chart.frequency_hz <= high)
    draw: dict[str, Any] = {"ls": "none", "rasterized": True}
    for keep, marker, color, size, face, label in (
        (other, "x", "#b0b0b0", 2.6, "#b0b0b0", "not stable"),
        (stable, "o", BLUE, 3.2, "none", "stable in frequency, damping and shape"),
        (chosen, "^", VERMILLION, 3.8, VERMILLION, "votes for a mode"),
    ):
        keep = keep & inside
        if not keep.any():
            continue
        ax.plot(
            chart.frequency_hz[keep],
            chart.order[keep],
            marker,
            color=color,
            ms=size,
            mfc=face,
            mew=0.7,
            label=f"{label} ({int(keep.sum())})",
            **draw,
        )
    for entry in modal.left_out:
        if low <= entry.frequency_hz <= high:
            first = entry is modal.left_out[0]
            ax.axvline(
                entry.frequency_hz,
                color=GREY,
                lw=0.8,
                ls="--",
                label="left out, see the remarks" if first else None,
            )
    if not chart.order.size:
        note(ax, "no poles")
    handles, labels = ax.get_legend_handles_labels()
    if frfs is not None:
        handles.append(Line2D([], [], color="#8a8a8a", lw=0.8))
        labels.append("CMIF")
    figure.legend(
        handles, labels, loc="lower center", ncols=4, frameon=False, handletextpad=0.4, columnspacing=1.4
    )
    ax.set_ylabel("model order, 1")
    ax.set_title(f"Stabilisation chart: {len(modes)} modes chosen", pad=27)
    mark_modes(ax, modes)
    return figure


@styled
def modes_overview(modal: ModalModel) -> Figure:
    """Damping ratio against frequency, and what the circle fits say of the frequency, with error bars."""
    figure = new_figure(4.0)
    grid = figure.add_gridspec(
        2, 1, hspace=0.16, height_ratios=(1.3, 1), **margins(figure, left=0.9, top=0.62)
    )
    top, bottom = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    f = np.array([m.frequency_hz for m in modal.modes])
    std = np.array([m.frequency_std_hz for m in modal.modes])
    z, z_std = (
        100 * np.array([getattr(m, a) for m in modal.modes]) for a in ("damping_ratio", "damping_std")
    )
    low, high, log = frequency_range(modal.band_hz, f, modal.frequency_hz, places(modal))
    top.errorbar(
        f,
        z,
        yerr=_bars(z_std),
        xerr=_bars(std),
        fmt=MARKERS[0],
        color=SERIES[0],
        capsize=2,
        label="pole, ±1σ",
        zorder=3,
    )
    bottom.errorbar(
        f,
        np.zeros_like(f),
        yerr=_bars(100 * std / np.maximum(f, 1e-12)),
        fmt=MARKERS[0],
        color=SERIES[0],
        capsize=2,
        zorder=3,
    )
    circles = [(m, c) for m in modal.modes for c in m.circles]
    if circles:
        at = np.array([m.frequency_hz for m, _ in circles])
        deviation = np.array([100 * (c.natural_frequency_hz / m.frequency_hz - 1) for m, c in circles])
        deviation_std = np.array([100 * c.natural_frequency_std_hz / m.frequency_hz for m, c in circles])
        damping = np.array([100 * c.damping_ratio for _, c in circles])
        damping_std = np.array([100 * c.damping_std for _, c in circles])
        style: dict[str, Any] = {
            "fmt": MARKERS[1],
            "color": SERIES[1],
            "ms": 3,
            "mfc": "none",
            "elinewidth": 0.5,
            "zorder": 2,
        }
        # beside the pole's marker rather than under it
        beside = at * 1.012 if log else at + 0.006 * (high - low)
        top.errorbar(beside, damping, yerr=_bars(damping_std), label="circle fits of this mode, ±1σ", **style)
        bottom.errorbar(beside, deviation, yerr=_bars(deviation_std), **style)
        limit = 1.6 * float(np.nanpercentile(np.abs(np.r_[deviation, 100 * std / f]), 90))
        bottom.set_ylim(-limit, limit)
        top.set_ylim(0, 1.35 * float(np.nanpercentile(np.r_[z + np.nan_to_num(z_std), damping], 92)))
    else:
        top.set_ylim(bottom=0)
    top.set_ylabel("damping ratio, %")
    bottom.set_ylabel("frequency against\nthe pole's, %")
    top.set_title("Frequencies and damping ratios", pad=27)
    if f.size:
        top.legend(loc="upper right", borderpad=0.3)
    frequency_axis(top, low, high, log, label=False)
    frequency_axis(bottom, low, high, log)
    mark_modes(top, list(f))
    mark_modes(bottom, list(f), numbers=False)
    figure.align_ylabels([top, bottom])
    return figure


def _bars(std: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(std), std, 0.0)
