"""Figures of an identified isolator: loops, energy over frequency, loss factor."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ema_pipeline.hysteresis.types import IsolatorResult, Loop, LoopFit
from ema_pipeline.report.style import (
    LINES,
    MARKERS,
    MEASURED,
    MODEL,
    SERIES,
    margins,
    new_figure,
    note,
    styled,
)

_COLUMNS = 3


@styled
def loops_figure(result: IsolatorResult) -> Figure:
    """Every measured loop with the model's, by the one set of parameters."""
    rows = -(-len(result.loops) // _COLUMNS)
    figure = new_figure(2.1 * rows + 0.5)
    grid = figure.add_gridspec(rows, _COLUMNS, hspace=0.6, wspace=0.3, **margins(figure))
    for k, (loop, fit) in enumerate(zip(result.loops, result.fits, strict=True)):
        ax = figure.add_subplot(grid[k // _COLUMNS, k % _COLUMNS])
        _draw(ax, loop, fit)
        if k == 0:
            ax.legend(loc="upper left")
        if k % _COLUMNS == 0:
            ax.set_ylabel("force, N")
        if k >= len(result.loops) - _COLUMNS:
            ax.set_xlabel("displacement, mm")
    return figure


def _draw(ax: Axes, loop: Loop, fit: LoopFit) -> None:
    x = 1e3 * np.append(loop.displacement, loop.displacement[0])
    ax.plot(x, np.append(loop.force, loop.force[0]), color=MEASURED, label="measured")
    ax.plot(x, np.append(fit.force, fit.force[0]), color=MODEL, ls="--", label="model")
    ax.set_title(f"{loop.frequency_hz:.3g} Hz, {1e3 * loop.amplitude_m:.3g} mm")


@styled
def energy_figure(result: IsolatorResult) -> Figure:
    """Energy per cycle over frequency, one line per amplitude, with the damper that its slope means."""
    figure = new_figure(3.0)
    ax = figure.add_subplot(figure.add_gridspec(1, 1, **margins(figure))[0, 0])
    ax.set_title("Energy per cycle")
    ax.set_xlabel("frequency, Hz")
    ax.set_ylabel("energy per cycle, J")
    for i, line in enumerate(result.energy):
        c = line.damping
        text = f"{1e3 * line.amplitude_m:.3g} mm: c = {c.value:.3g} ± {c.std:.2g} N·s/m"
        if not line.possible:
            text += ", cannot be"
        colour = SERIES[i % len(SERIES)]
        ax.errorbar(
            line.frequency_hz,
            line.energy_j,
            2 * line.energy_std_j,
            fmt=MARKERS[i % len(MARKERS)],
            color=colour,
            label=text,
            capsize=2,
        )
        f = np.linspace(line.frequency_hz.min(), line.frequency_hz.max(), 2)
        ax.plot(
            f, line.slope * 2 * np.pi * f + line.intercept, color=colour, ls=LINES[i % len(LINES)], lw=0.9
        )
    if result.energy:
        most = max(float(np.max(line.energy_j)) for line in result.energy)
        ax.set_ylim(0.0, (1.15 + 0.1 * len(result.energy)) * most)
        ax.legend(loc="upper left")
    else:
        note(ax, "all loops were taken at one frequency")
    return figure


@styled
def loss_factor_figure(result: IsolatorResult) -> Figure:
    """Loss factor over amplitude and over frequency."""
    figure = new_figure(2.8)
    grid = figure.add_gridspec(1, 2, wspace=0.25, **margins(figure))
    x = {
        "amplitude, mm": [1e3 * p.amplitude_m for p in result.loss],
        "frequency, Hz": [p.frequency_hz for p in result.loss],
    }
    other = list(reversed(x.values()))
    eta, std = np.array([p.value for p in result.loss]), np.array([p.std for p in result.loss])
    for k, (label, values) in enumerate(x.items()):
        ax = figure.add_subplot(grid[0, k])
        keys = [f"{v:.3g}" for v in other[k]]
        for i, key in enumerate(dict.fromkeys(keys)):
            at = [j for j in range(len(keys)) if keys[j] == key]
            order = sorted(at, key=lambda j: values[j])
            unit = "Hz" if k == 0 else "mm"
            ax.errorbar(
                [values[j] for j in order],
                eta[order],
                2 * std[order],
                marker=MARKERS[i % len(MARKERS)],
                color=SERIES[i % len(SERIES)],
                ls=LINES[i % len(LINES)],
                capsize=2,
                label=f"{key} {unit}",
            )
        ax.set_xlabel(label)
        ax.set_ylabel("loss factor η")
        if np.any(np.isfinite(eta)):
            ax.set_ylim(0.0, 1.15 * float(np.nanmax(eta + 2 * std)))
        if len(set(keys)) <= 6:
            ax.legend(loc="best")
    return figure


def isolator_figures(result: IsolatorResult) -> dict[str, Figure]:
    """All figures by name."""
    return {
        "loops": loops_figure(result),
        "energy": energy_figure(result),
        "loss_factor": loss_factor_figure(result),
    }
