"""MAC matrices, and measured against model frequencies for the pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from ema_pipeline.correlate.types import Pairing
from ema_pipeline.modal.assurance import auto_mac
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.report.style import (
    MEASURED,
    MODEL,
    PURPLE,
    frequency_axis,
    log_y,
    margins,
    mark_modes,
    new_figure,
    note,
    styled,
)

NUMBERS_UP_TO = 20
_LABELS_UP_TO = 26


@styled
def auto_mac_matrix(modal: ModalModel) -> Figure:
    """MAC of the measured modes with each other: large off-diagonal terms mean too few sensors."""
    shapes = np.array([m.shape for m in modal.modes]) if modal.modes else np.empty((0, len(modal.dofs)))
    names = [f"{i + 1}: {m.frequency_hz:.4g}" for i, m in enumerate(modal.modes)]
    return _matrix(
        auto_mac(shapes),
        names,
        names,
        "measured mode, Hz",
        "measured mode, Hz",
        "Measured modes with each other",
    )


@styled
def pairing_mac_matrix(pairing: Pairing, modal: ModalModel) -> Figure:
    """MAC of measured with model modes; pairs are framed. Model modes far above the band are left out."""
    paired = {p.model for p in pairing.pairs}
    top = 1.15 * max([modal.band_hz[1], *(m.frequency_hz for m in modal.modes)])
    columns = [j for j, m in enumerate(pairing.model_modes) if j in paired or m.frequency_hz <= top]
    rows = [f"{i + 1}: {m.frequency_hz:.4g}" for i, m in enumerate(modal.modes)]
    names = [f"{j + 1}: {pairing.model_modes[j].frequency_hz:.4g}" for j in columns]
    frames = [(p.measured, columns.index(p.model)) for p in pairing.pairs]
    return _matrix(
        pairing.mac[:, columns],
        rows,
        names,
        "measured mode, Hz",
        "model mode, Hz",
        "Measured with model modes (frames: pairs)",
        frames,
    )


def _matrix(
    values: NDArray[np.float64],
    rows: Sequence[str],
    columns: Sequence[str],
    row_label: str,
    column_label: str,
    title: str,
    frames: Sequence[tuple[int, int]] = (),
) -> Figure:
    n, m = max(len(rows), 1), max(len(columns), 1)
    cell = min(0.3, 5.0 / m, 5.4 / n)
    left, bottom, right, top = 1.0, 0.95, 1.2, 0.45
    side_x, side_y = max(m * cell, 1.6), max(n * cell, 1.2)
    figure = new_figure(side_y + bottom + top, max(side_x + left + right, 4.2))
    width, height = figure.get_size_inches()
    ax = figure.add_axes((left / width, bottom / height, side_x / width, side_y / height))
    ax.set_title(title)
    if not (rows and columns):
        note(ax, "no modes")
        ax.set_axis_off()
        return figure
    image = ax.imshow(
        values, cmap="Blues", vmin=0, vmax=1, aspect="auto", origin="lower", interpolation="nearest"
    )
    ax.grid(False)
    for axis, names in ((ax.xaxis, columns), (ax.yaxis, rows)):
        step = -(-len(names) // _LABELS_UP_TO)
        axis.set_ticks(range(0, len(names), step), names[::step])
    ax.tick_params(axis="x", rotation=90, labelsize=6.2, length=2)
    ax.tick_params(axis="y", labelsize=6.2, length=2)
    ax.set_xlabel(column_label)
    ax.set_ylabel(row_label)
    if max(n, m) <= NUMBERS_UP_TO:
        for i in range(n):
            for j in range(m):
                v = values[i, j]
                text = "–" if not np.isfinite(v) else f"{v:.2f}"[1:] if v < 0.995 else "1"
                ax.text(
                    j, i, text, ha="center", va="center", fontsize=5.4, color="white" if v > 0.55 else "black"
                )
    for i, j in frames:
        ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, ec=MODEL, lw=1.3))
    bar = figure.add_axes(((left + side_x + 0.15) / width, bottom / height, 0.14 / width, side_y / height))
    figure.colorbar(image, cax=bar).set_label("MAC, 1")
    return figure


@styled
def pairing_plot(pairing: Pairing, modal: ModalModel, band_percent: float = 5.0) -> Figure:
    """Frequencies of the pairs on a 1:1 line with a band of ±`band_percent`, and the deviation of each pair.

    Modes without a partner stand on the axes' edges.
    """
    figure = new_figure(5.3)
    grid = figure.add_gridspec(2, 1, hspace=0.5, height_ratios=(2.2, 1), **margins(figure, left=0.75))
    ax, below = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    lone_measured = [u.frequency_hz for u in pairing.unpaired_measured]
    limit = 1.2 * max([modal.band_hz[1], *(m.frequency_hz for m in modal.modes)])
    lone_model = [u.frequency_hz for u in pairing.unpaired_model if 0 < u.frequency_hz <= limit]
    x = np.array([p.model_frequency_hz for p in pairing.pairs])
    y = np.array([p.measured_frequency_hz for p in pairing.pairs])
    std = np.array([modal.modes[p.measured].frequency_std_hz for p in pairing.pairs])
    every = np.r_[x, y, lone_measured, lone_model]
    every = every[every > 0]
    low, high = (0.8 * every.min(), 1.25 * every.max()) if every.size else (1.0, 10.0)
    if low < 1e-3 * high:
        low = 1e-3 * high
    log = bool(high > 12 * low)
    ends = np.geomspace(low, high, 200)
    ax.plot(ends, ends, color="black", lw=0.8, label="measured = model")
    ax.fill_between(
        ends,
        ends * (1 - band_percent / 100),
        ends * (1 + band_percent / 100),
        color="#e8e2c8",
        lw=0,
        label=f"±{band_percent:g} %",
    )
    if x.size:
        ax.errorbar(
            x,
            y,
            yerr=np.where(np.isfinite(std), std, 0),
            fmt="o",
            color=MEASURED,
            ms=4.5,
            mfc="white",
            label="pair",
            zorder=4,
        )
    frequency_axis(ax, low, high, log)
    if log:
        log_y(ax)
        ax.yaxis.set_major_locator(ax.xaxis.get_major_locator())
        ax.yaxis.set_major_formatter(ax.xaxis.get_major_formatter())
        ax.yaxis.set_minor_locator(ax.xaxis.get_minor_locator())
    ax.set_ylim(low, high)
    if lone_measured:
        ax.plot(
            [0.008] * len(lone_measured),
            lone_measured,
            ">",
            color=PURPLE,
            ms=6,
            clip_on=False,
            transform=ax.get_yaxis_transform(),
            label=f"measured, no partner ({len(lone_measured)})",
        )
    if lone_model:
        ax.plot(
            lone_model,
            [0.012] * len(lone_model),
            "^",
            color=MODEL,
            ms=6,
            clip_on=False,
            transform=ax.get_xaxis_transform(),
            label=f"model, no partner ({len(lone_model)})",
        )
    ax.set_xlabel("model frequency, Hz")
    ax.set_ylabel("measured frequency, Hz")
    ax.set_title("Pairs of measured and model modes")
    ax.legend(loc="upper left", borderpad=0.4)
    if x.size:
        percent = 100 * (y / x - 1)
        bars = 100 * np.where(np.isfinite(std), std, 0) / x
        reach = 1.25 * max(float(np.max(np.abs(percent) + bars)), 0.1)
        below.axhspan(-band_percent, band_percent, color="#e8e2c8", lw=0)
        below.errorbar(y, percent, yerr=bars, fmt="o", color=MEASURED, capsize=2, ms=4)
        below.set_ylim(-reach, reach)
    else:
        note(below, "no pairs")
    below.axhline(0, color="black", lw=0.8)
    frequency_axis(below, low, high, log)
    below.set_xlabel("measured frequency, Hz   (numbers above: measured modes)", color="black")
    below.set_ylabel("(measured − model)\n/ model, %")
    mark_modes(below, [m.frequency_hz for m in modal.modes])
    figure.align_ylabels([ax, below])
    return figure
