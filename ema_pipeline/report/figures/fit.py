"""The error function over a stiffness, the fitted parameters and their correlation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ema_pipeline.fit.types import ErrorSweep, FitResult
from ema_pipeline.number_text import format_value, plain, prefixed
from ema_pipeline.report.name_text import words
from ema_pipeline.report.style import (
    BLACK,
    LINES,
    MARKERS,
    MEASURED,
    SERIES,
    VERMILLION,
    log_y,
    margins,
    new_figure,
    note,
    styled,
)

_NUMBERS_UP_TO = 14


@styled
def error_sweeps(sweeps: Sequence[ErrorSweep]) -> Figure:
    """Error function ε over stiffness, one panel per parameter, one curve per number of modes."""
    groups: dict[tuple[str, str], list[ErrorSweep]] = {}
    for sweep in sweeps:
        groups.setdefault((sweep.parameter, sweep.configuration), []).append(sweep)
    rows = -(-len(groups) // 2)
    figure = new_figure(3.5 * rows)
    grid = figure.add_gridspec(rows, 2, hspace=0.5, wspace=0.26, **margins(figure, top=0.5, bottom=0.95))
    for k, ((parameter, configuration), curves) in enumerate(groups.items()):
        ax = figure.add_subplot(grid[k // 2, k % 2] if len(groups) > 1 else grid[0, :])
        ax.set_title(f"{words(parameter)}\n{configuration}")
        for i, sweep in enumerate(curves):
            factor, unit = prefixed(sweep.minimum, "N/m")
            least = f"{plain(sweep.minimum * factor, 3)} {unit}"
            verdict = f"minimum at {least}" if sweep.identified else "not identified"
            ax.plot(
                sweep.values,
                sweep.error,
                color=SERIES[i],
                ls=LINES[i],
                label=f"{sweep.mode_count} modes: {verdict}",
            )
            at = int(np.nanargmin(sweep.error))
            ax.plot(
                sweep.values[at],
                sweep.error[at],
                MARKERS[i],
                color=SERIES[i],
                ms=6,
                mfc=SERIES[i] if sweep.identified else "white",
                zorder=4,
            )
        every = np.concatenate([s.error for s in curves])
        every = every[np.isfinite(every) & (every > 0)]
        if every.size and every.max() > 12 * every.min():
            log_y(ax)
        elif every.size:
            ax.set_ylim(0, 1.2 * float(every.max()))
        ax.set_xscale("log")
        ax.set_xlim(curves[0].values[0], curves[0].values[-1])
        ax.set_xlabel("stiffness, N/m")
        ax.set_ylabel("error function ε, 1")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False, handlelength=2.8)
    return figure


@styled
def parameter_forest(fit: FitResult) -> Figure:
    """(value − nominal)/tolerance with ±1σ for parameters with a tolerance; the free ones are named below.

    A hollow marker stands for a parameter that the data do not narrow.
    """
    held = [
        p
        for p in (fit.parameters[n] for n in fit.parameters)
        if not p.free and np.isfinite(p.prior_std) and p.prior_std > 0
    ]
    free = [p for p in fit.parameters.values() if p.free]
    figure = new_figure(1.15 + 0.21 * max(len(held), 2) + 0.17 * len(free))
    grid = figure.add_gridspec(
        1, 1, **margins(figure, left=1.85, right=1.75, top=0.35, bottom=0.62 + 0.17 * len(free))
    )
    ax = figure.add_subplot(grid[0])
    ax.set_title("Fitted parameters against their tolerances")
    ax.axvspan(-2, 2, color="#f0f0f0", lw=0)
    ax.axvspan(-1, 1, color="#dfe9f2", lw=0)
    ax.axvline(0, color=BLACK, lw=0.8)
    reach = 3.2
    for k, p in enumerate(held):
        z, bar = (p.value - p.nominal) / p.prior_std, p.std / p.prior_std
        color = VERMILLION if abs(z) > 2 else MEASURED
        ax.errorbar(
            z,
            k,
            xerr=bar if np.isfinite(bar) else 0,
            fmt="D" if abs(z) > 2 else "o",
            color=color,
            capsize=2,
            mfc=color if p.identified else "white",
            ms=4.5,
        )
        reach = max(reach, 1.1 * (abs(z) + (bar if np.isfinite(bar) else 0)))
        ax.annotate(
            format_value(p.value, p.std, p.unit),
            (1.02, k),
            xycoords=("axes fraction", "data"),
            fontsize=7,
            va="center",
            color=color if abs(z) > 2 else BLACK,
        )
    if not held:
        note(ax, "no parameter with a tolerance")
    ax.set_yticks(range(len(held)), [words(p.name) for p in held])
    ax.set_ylim(len(held) - 0.4, -0.6)
    ax.set_xlim(-reach, reach)
    ax.grid(False, axis="y")
    ax.set_xlabel(
        "(value − nominal)/tolerance, 1    bands: ±1 and ±2 tolerances; hollow: not narrowed by the data"
    )
    ax.xaxis.label.set_fontsize(7)
    height = figure.get_size_inches()[1]
    for k, p in enumerate(free):
        verdict = "" if p.identified else " (not identified)"
        figure.text(
            0.02,
            (0.1 + 0.17 * (len(free) - 1 - k)) / height,
            f"free: {words(p.name)} = {format_value(p.value, p.std, p.unit)}{verdict}",
            fontsize=7.5,
            va="bottom",
            fontweight="bold" if p.identified else "normal",
        )
    return figure


@styled
def correlation_matrix(fit: FitResult) -> Figure:
    """Posterior correlation of the parameters; pairs near ±1 cannot be told apart by these data."""
    n = len(fit.names)
    cell = min(0.36, 4.6 / max(n, 1))
    side = max(n * cell, 1.0)
    left = bottom = 1.9
    figure = new_figure(side + bottom + 0.4, min(left + side + 1.0, 7.4))
    width, height = figure.get_size_inches()
    ax = figure.add_axes((left / width, bottom / height, side / width, side / height))
    image = ax.imshow(fit.correlation, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest", aspect="auto")
    names = [words(name) for name in fit.names]
    ax.set_xticks(range(n), names, rotation=90, fontsize=6.2)
    ax.set_yticks(range(n), names, fontsize=6.2)
    ax.grid(False)
    ax.set_title("Correlation of the fitted parameters")
    if n <= _NUMBERS_UP_TO:
        for i in range(n):
            for j in range(n):
                v = float(fit.correlation[i, j])
                text = "1" if v > 0.995 else f"{v:.2f}".replace("0.", ".").replace("-", "−")
                ax.text(
                    j,
                    i,
                    text,
                    ha="center",
                    va="center",
                    fontsize=5.6,
                    color="white" if abs(v) > 0.65 else "black",
                )
    bar = figure.add_axes(((left + side + 0.15) / width, bottom / height, 0.14 / width, side / height))
    figure.colorbar(image, cax=bar).set_label("correlation, 1")
    return figure
