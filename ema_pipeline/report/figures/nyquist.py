"""Nyquist sheets: one per mode, one panel per FRF with its fitted circle."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ema_pipeline.modal.circle import on_circle
from ema_pipeline.modal.types import CircleFit, ModalModel
from ema_pipeline.number_text import format_percent, format_value, plain
from ema_pipeline.report.style import (
    GREEN,
    GREY,
    MEASURED,
    MODEL,
    PURPLE,
    margins,
    new_figure,
    note,
    styled,
)

CHANNELS_PER_SHEET = 4


@styled
def nyquist_sheet(modal: ModalModel, index: int, calibrated: bool = True) -> Figure:
    """Nyquist circles of one mode in its best FRFs.

    Parameters
    ----------
    modal : ModalModel
    index : int
        Mode.
    calibrated : bool
        False where the force is in volts.
    """
    mode = modal.modes[index]
    circles = mode.circles[:CHANNELS_PER_SHEET]
    columns = min(max(len(circles), 1), 2)
    rows = -(-max(len(circles), 1) // 2)
    figure = new_figure(0.95 + 2.7 * rows)
    grid = figure.add_gridspec(rows, 2, hspace=0.34, wspace=0.3, **margins(figure, top=0.76))
    frequency = format_value(mode.frequency_hz, mode.frequency_std_hz, "Hz")
    damping = format_percent(mode.damping_ratio, mode.damping_std)
    figure.text(
        0.5,
        1 - 0.13 / figure.get_size_inches()[1],
        f"Mode {index + 1}: {frequency}, ζ = {damping} ({mode.method})",
        ha="center",
        va="top",
        fontsize=9,
        fontweight="bold",
    )
    if not circles:
        ax = figure.add_subplot(grid[0, :])
        ax.set_axis_off()
        note(ax, "no circle fit for this mode")
    for k, circle in enumerate(circles):
        where = grid[k // 2, :] if columns == 1 else grid[k // 2, k % 2]
        _panel(figure.add_subplot(where), circle, mode.frequency_hz, calibrated)
    if circles:
        entries = {
            label: h for ax in figure.axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            entries.values(),
            entries.keys(),
            loc="upper center",
            ncols=5,
            frameon=False,
            handlelength=1.6,
            bbox_to_anchor=(0.5, 1 - 0.26 / figure.get_size_inches()[1]),
            columnspacing=1.4,
            fontsize=6.5,
        )
    return figure


def _panel(ax: Axes, circle: CircleFit, pole_hz: float, calibrated: bool) -> None:
    largest = float(np.max(np.abs(circle.points), initial=0.0)) or 1.0
    exponent = int(np.floor(np.log10(largest)))
    scale = 10.0**-exponent
    z, centre, radius = circle.points * scale, circle.centre * scale, circle.radius * scale
    angle = np.linspace(0, 2 * np.pi, 181)
    ax.axhline(0, color="#bbbbbb", lw=0.6)
    ax.axvline(0, color="#bbbbbb", lw=0.6)
    ax.plot(
        centre.real + radius * np.cos(angle),
        centre.imag + radius * np.sin(angle),
        "--",
        color=MODEL,
        lw=1.1,
        label="fitted circle",
    )
    ax.plot(z.real, z.imag, "o-", color=MEASURED, ms=3.2, lw=0.4, label="measured lines")
    _mark(ax, circle, circle.natural_frequency_hz, scale, "*", PURPLE, 11, "most rapid sweep (circle)")
    _mark(ax, circle, pole_hz, scale, "D", "#000000", 6, "frequency of the pole", hollow=True)
    half = np.array([1 - circle.damping_in_frf, 1 + circle.damping_in_frf]) * circle.natural_frequency_hz
    for f, label in zip(half, ("half-power points", "_"), strict=True):
        _mark(ax, circle, float(f), scale, "s", GREEN, 5, label)
    _equal_limits(ax, z, centre, radius)
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(5))
    unit = f"{_power(exponent)}(m/s)/{'N' if calibrated else 'V'}"
    ax.set_xlabel(f"Re mobility, {unit}")
    ax.set_ylabel(f"Im mobility, {unit}")
    ax.set_title(f"{circle.output.point} ← {circle.input.point}")
    ax.text(
        0.985,
        0.03,
        f"f = {format_value(circle.natural_frequency_hz, circle.natural_frequency_std_hz, 'Hz')}\n"
        f"ζ = {format_percent(circle.damping_ratio, circle.damping_std)}\n"
        f"misfit {100 * circle.residual:.1f} % of radius",
        transform=ax.transAxes,
        ha="right",
        va="bottom",
        fontsize=6.5,
        linespacing=1.35,
        bbox={"boxstyle": "square,pad=0.3", "fc": "white", "ec": "#cccccc", "lw": 0.5},
    )
    if circle.pair_damping.size >= 3:
        _damping_spread(ax, circle)


def _equal_limits(ax: Axes, z: NDArray[np.complex128], centre: complex, radius: float) -> None:
    """Equal scales, with room on the right for the pair damping and the words."""
    figure = ax.get_figure()
    assert isinstance(figure, Figure)
    box, (width, height) = ax.get_position(), figure.get_size_inches()
    left = min(float(z.real.min(initial=np.inf)), centre.real - radius)
    right = max(float(z.real.max(initial=-np.inf)), centre.real + radius)
    low = min(float(z.imag.min(initial=np.inf)), centre.imag - radius)
    high = max(float(z.imag.max(initial=-np.inf)), centre.imag + radius)
    per_inch = max((right - left) / (0.58 * box.width * width), (high - low) / (0.78 * box.height * height))
    half = 0.5 * per_inch * box.height * height
    start = left - 0.03 * per_inch * box.width * width
    ax.set_xlim(start, start + per_inch * box.width * width)
    ax.set_ylim(0.5 * (low + high) - half, 0.5 * (low + high) + half)


def _damping_spread(ax: Axes, circle: CircleFit) -> None:
    """Small histogram of the damping of all half-power pairs, without axes of its own (they are slow)."""
    percent = 100 * circle.pair_damping[np.isfinite(circle.pair_damping)]
    low, high = (float(v) for v in np.percentile(percent, [1, 99]))
    if not high > low:
        return
    counts, edges = np.histogram(percent, bins=12, range=(low, high))
    left, bottom, width, height = 0.735, 0.38, 0.24, 0.16
    x = left + width * (edges - low) / (high - low)
    y = bottom + height * counts / counts.max()
    bars = [[(x[k], bottom), (x[k], y[k]), (x[k + 1], y[k]), (x[k + 1], bottom)] for k in range(12)]
    ax.add_artist(PolyCollection(bars, transform=ax.transAxes, fc="#9ec7e3", ec=MEASURED, lw=0.4, zorder=4))
    mean = left + width * (100 * circle.damping_ratio - low) / (high - low)
    if left <= mean <= left + width:
        ax.add_artist(
            Line2D(
                [mean, mean],
                [bottom, bottom + 1.05 * height],
                transform=ax.transAxes,
                color=MODEL,
                lw=1,
                zorder=5,
            )
        )
    words = {"transform": ax.transAxes, "ha": "center", "fontsize": 5.8, "color": GREY}
    ax.text(left + width / 2, bottom + 1.1 * height, "ζ of all pairs", va="bottom", **words)  # type: ignore[arg-type]
    ax.text(left + width / 2, bottom - 0.015, f"{plain(low)} … {plain(high)} %", va="top", **words)  # type: ignore[arg-type]


def _mark(
    ax: Axes,
    circle: CircleFit,
    f: float,
    scale: float,
    marker: str,
    color: str,
    size: float,
    label: str,
    hollow: bool = False,
) -> None:
    """Mark a frequency on the circle, within the lines measured."""
    lines = circle.frequency_hz
    if lines.size < 2 or not lines[0] <= f <= lines[-1]:
        return
    at = on_circle(circle, f) * scale
    ax.plot(
        at.real,
        at.imag,
        marker,
        color=color,
        ms=size,
        mfc="none" if hollow else color,
        mew=1.0,
        mec=color if hollow else "white",
        ls="none",
        label=label,
        zorder=5,
    )


def _power(exponent: int) -> str:
    digits = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return "" if exponent == 0 else f"10{digits} "
