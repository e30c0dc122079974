"""Figures of simulated records: the response beside the models', what each leaves, and loops of hysteresis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ema_pipeline.diagnose.hysteresis_loop import HysteresisLoop
from ema_pipeline.observations.free_run import RecordError
from ema_pipeline.report.style import GREY, MEASURED, MODEL, SECOND, margins, new_figure, styled

_SCALES = ((1e-9, 1e9, "n"), (1e-6, 1e6, "µ"), (1e-3, 1e3, "m"))
_MOST = 6
"""Rows of a figure."""


def scaled_unit(size: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which numbers of this size are easy to read: a thousandth of a unit, of that, …"""
    for limit, factor, prefix in _SCALES:
        if size < 1e3 * limit * 0.5:
            return factor, prefix + unit
    return 1.0, unit


@styled
def records_figure(errors: Sequence[RecordError]) -> Figure:
    """Left an excerpt of every record, right the lines of the response and of what both models leave."""
    shown = errors[:_MOST]
    figure = new_figure(2.1 * len(shown) + 0.8)
    grid = figure.add_gridspec(len(shown), 2, hspace=0.75, wspace=0.3, **margins(figure, left=0.75, top=0.7))
    for k, e in enumerate(shown):
        ax = figure.add_subplot(grid[k, 0])
        factor, unit = scaled_unit(float(abs(e.measured).max()), e.unit)
        count = min(len(e.measured), 240)
        middle = int(abs(e.measured).argmax())
        first = max(min(middle - count // 2, len(e.measured) - count), 0)
        part = slice(first, first + count)
        time = e.at_s + (first + np.arange(count)) / e.sample_rate_hz
        ax.plot(time, factor * e.measured[part], color=MEASURED, lw=1.8, alpha=0.55, label="measured")
        ax.plot(time, factor * e.linear[part], color=SECOND, ls=":", lw=1.1, label="without effects")
        ax.plot(time, factor * e.simulated[part], color=MODEL, ls="--", lw=0.9, label="model")
        ax.set_title(f"{e.record}, {e.sensor} ({e.use.replace('_', ' ')})")
        ax.set_ylabel(f"{e.quantity}, {unit}")
        ax.set_xlabel("time, s")
        right = figure.add_subplot(grid[k, 1])
        right.semilogy(e.frequency_hz, e.size, color=MEASURED, lw=1.4, alpha=0.6)
        right.semilogy(e.frequency_hz, e.rest_before, color=SECOND, ls=":", lw=1.1)
        right.semilogy(e.frequency_hz, e.rest, color=MODEL, ls="--", lw=0.9)
        right.set_title("response, and what each model leaves")
        right.set_ylabel(f"amplitude, {e.unit}")
        right.set_xlabel("frequency, Hz")
        if k == 0:
            figure.legend(*ax.get_legend_handles_labels(), loc="upper center", ncols=3)
    return figure


@styled
def hysteresis_figure(loops: Sequence[HysteresisLoop]) -> Figure:
    """Every loop at the amplitude of the records, with a band of two standard deviations."""
    figure = new_figure(2.9)
    grid = figure.add_gridspec(1, max(len(loops), 2), wspace=0.35, **margins(figure, left=0.8, top=0.4))
    for k, loop in enumerate(loops[:3]):
        ax = figure.add_subplot(grid[0, k])
        factor, unit = scaled_unit(loop.amplitude_m, "m")
        x = factor * loop.displacement
        half = len(x) // 4
        for part in (slice(half, 3 * half), [*range(3 * half, len(x)), *range(half)]):
            low, high = (
                loop.force[part] - 2 * loop.force_std[part],
                loop.force[part] + 2 * loop.force_std[part],
            )
            ax.fill_between(x[part], low, high, color=GREY, alpha=0.4, lw=0)
        ax.plot([*x, x[0]], [*loop.force, loop.force[0]], color=MODEL, lw=1.2)
        ax.set_title(loop.label.replace("@", " at "))
        ax.set_xlabel(f"stretch, {unit}")
        ax.set_ylabel("force, N")
    return figure
