"""Measured hits beside simulated ones: signals after the blow, and the share of each level that a model misses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ema_pipeline.diagnose.types import Ladder, Rung, TimeTrace
from ema_pipeline.number_text import plain
from ema_pipeline.report.diagnosis import label_words
from ema_pipeline.report.style import BLACK, BLUE, GREY, VERMILLION, WIDTH_IN, margins, new_figure, styled

_UNITS = {"acceleration": "m/s²", "velocity": "m/s", "displacement": "m"}
_SHOWN = 0.5
"""Share of the window that is drawn; later the signals are small."""


def trace_groups(traces: Sequence[TimeTrace]) -> list[list[TimeTrace]]:
    """Traces of one configuration belong on one sheet, the softest level first."""
    names = dict.fromkeys(t.configuration for t in traces)
    return [sorted((t for t in traces if t.configuration == n), key=lambda t: t.force_n) for n in names]


def traces_caption(traces: Sequence[TimeTrace]) -> str:
    """What the sheet shows."""
    t = traces[0]
    return (
        f"{t.configuration}: {t.quantity} at {t.sensor.point} after blows on {t.impact.point}, measured and simulated "
        "with the measured force, in the band of the modes; below each what the simulation misses"
    )


@styled
def hit_traces(traces: Sequence[TimeTrace], effects: tuple[str, ...]) -> Figure:
    """One row per force level: measured against the base model, and against the model with the effects.

    Parameters
    ----------
    traces : sequence of TimeTrace
        Of one configuration.
    effects : tuple of str
        Labels of the last rung.
    """
    rows = len(traces)
    figure = new_figure(0.75 + 1.55 * rows, WIDTH_IN)
    grid = figure.add_gridspec(
        2 * rows, 2, height_ratios=[2.2, 1] * rows, hspace=0.12, wspace=0.08,
        **margins(figure, left=0.72, right=0.1, top=0.42, bottom=0.66),
    )  # fmt: skip
    with_effects = " + ".join(label_words(e) for e in effects) or "the same model"
    for k, t in enumerate(traces):
        shown = slice(0, max(int(_SHOWN * t.measured.size), 2))
        time_ms = 1e3 * np.arange(t.measured.size)[shown] / t.sample_rate_hz
        size = 1.08 * float(np.max(np.abs(t.measured[shown])))
        missed = 1.08 * max(float(np.max(np.abs(t.measured - s)[shown])) for s in (t.before, t.after))
        for column, (simulated, colour) in enumerate(((t.before, VERMILLION), (t.after, BLUE))):
            above, below = (figure.add_subplot(grid[2 * k + i, column]) for i in (0, 1))
            above.plot(time_ms, t.measured[shown], color=BLACK, lw=0.9, label="measured")
            above.plot(time_ms, simulated[shown], color=colour, lw=0.9, ls="--", label="simulated")
            below.plot(time_ms, (t.measured - simulated)[shown], color=colour, lw=0.7)
            above.set_ylim(-size, size)
            below.set_ylim(-missed, missed)
            for ax in (above, below):
                ax.set_xlim(time_ms[0], time_ms[-1])
                if column:
                    ax.tick_params(labelleft=False)
                if ax is above or k < rows - 1:
                    ax.tick_params(labelbottom=False)
            share = np.sqrt(np.mean((t.measured - simulated) ** 2) / np.mean(t.measured**2))
            above.text(
                0.99, 0.95, f"{t.force_n:.3g} N: misses {plain(100 * float(share), 2)} %",
                transform=above.transAxes, ha="right", va="top", fontsize=7,
                bbox={"fc": "white", "ec": "none", "pad": 0.6},
            )  # fmt: skip
            if not column:
                above.set_ylabel(_UNITS.get(t.quantity, ""))
                below.set_ylabel("missed")
            if k == 0:
                above.set_title("base model" if not column else f"with {with_effects}", loc="left")
            if k == rows - 1:
                below.set_xlabel("time, ms")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=2, frameon=False)
    return figure


@styled
def level_misfits(ladder: Ladder) -> Figure:
    """Share of the signals that the base model and the last rung miss, by force level, fitted and held out."""
    first, last = ladder.rungs[0], ladder.rungs[-1]
    figure = new_figure(2.5, WIDTH_IN)
    ax = figure.add_subplot(
        figure.add_gridspec(1, 1, **margins(figure, left=0.62, right=0.1, top=0.32, bottom=0.78))[0]
    )
    at = np.arange(len(ladder.force_n))
    pairs = [(first, VERMILLION, "base model")]
    if last is not first:
        pairs.append((last, BLUE, "with " + " + ".join(label_words(e) for e in last.effects)))
    width = 0.8 / (2 * len(pairs))
    for k, (rung, colour, name) in enumerate(pairs):
        _bars(ax, at + (2 * k - len(pairs) + 0.5) * width, rung, width, colour, name)
    ax.set_xticks(at, [f"{f:.3g} N" for f in ladder.force_n])
    ax.set_ylabel("missed, % of the signal")
    ax.set_ylim(0, 1.18 * ax.get_ylim()[1])
    ax.set_xlabel("force level")
    ax.set_title(
        "Misfit of the simulated hits: root mean square of what is missed over that of the signal", loc="left"
    )
    ax.grid(False, axis="x")
    figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=6.5)
    return figure


def _bars(ax: Axes, at: np.ndarray, rung: Rung, width: float, colour: str, name: str) -> None:
    """Fitted and held out, side by side, with their numbers."""
    for values, shift, face, hatch, kind in (
        (rung.misfit, 0.0, colour, "", "fitted"),
        (rung.heldout_misfit, width, "white", "////", "level left out of the fit"),
    ):
        percent = 100 * np.asarray(values, dtype=float)
        ax.bar(
            at + shift, np.nan_to_num(percent), 0.92 * width, fc=face, ec=colour, hatch=hatch, lw=0.8,
            label=f"{name}, {kind}",
        )  # fmt: skip
        for x, p in zip(at + shift, percent, strict=True):
            text = plain(float(p), 2) if np.isfinite(p) else "–"
            ax.annotate(
                text, (x, p if np.isfinite(p) else 0), (0, 2), textcoords="offset points",
                ha="center", va="bottom", fontsize=6.5, color=colour if np.isfinite(p) else GREY,
            )  # fmt: skip
