"""Figures of an identified isolator: loops, energy over frequency, loss factor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ema_pipeline.loops.types import IsolatorResult, Loop, LoopFit, LoopModel
from ema_pipeline.number_text import format_value
from ema_pipeline.report.style import (
    GREY,
    LINES,
    MARKERS,
    MEASURED,
    MODEL,
    SECOND,
    SERIES,
    margins,
    new_figure,
    note,
    styled,
)

_COLUMNS = 3
_ENERGY = 0.03


@styled
def loops_figure(result: IsolatorResult) -> Figure:
    """Every measured loop with the published model's, by one set of parameters.

    Where that misses the energy of some loop, also by parameters of each loop's own.
    """
    one_set = all(abs(fit.energy_error) < _ENERGY for fit in result.fits)
    rows = -(-len(result.loops) // _COLUMNS)
    figure = new_figure(2.15 * rows + 0.75)
    grid = figure.add_gridspec(rows, _COLUMNS, hspace=0.6, wspace=0.34, **margins(figure, left=0.8, top=0.62))
    for k, (loop, fit) in enumerate(zip(result.loops, result.fits, strict=True)):
        ax = figure.add_subplot(grid[k // _COLUMNS, k % _COLUMNS])
        _draw(ax, loop, fit)
        if not one_set:
            x, force = 1e3 * loop.displacement, result.alone[k].force
            ax.plot(
                np.append(x, x[0]),
                np.append(force, force[0]),
                color=SECOND,
                ls="-.",
                lw=0.9,
                label="by itself",
            )
        if k == 0:
            figure.legend(*ax.get_legend_handles_labels(), loc="upper center", ncols=3)
        if k % _COLUMNS == 0:
            ax.set_ylabel("force, N")
        if k >= len(result.loops) - _COLUMNS:
            ax.set_xlabel("displacement, mm")
    return figure


@styled
def models_figure(loops: Sequence[Loop], models: Sequence[LoopModel]) -> Figure:
    """Every measured loop with that of the linear spring and that of the last model."""
    rows = -(-len(loops) // _COLUMNS)
    figure = new_figure(2.15 * rows + 0.75)
    grid = figure.add_gridspec(
        rows, _COLUMNS, hspace=0.55, wspace=0.34, **margins(figure, left=0.8, top=0.62)
    )
    for k, loop in enumerate(loops):
        ax = figure.add_subplot(grid[k // _COLUMNS, k % _COLUMNS])
        x = 1e3 * np.append(loop.displacement, loop.displacement[0])
        ax.plot(x, np.append(loop.force, loop.force[0]), color=MEASURED, lw=1.8, alpha=0.55, label="measured")
        for model, (colour, style, name) in zip(_ends(models), _MODELS, strict=False):
            force = model.fits[k].force
            ax.plot(x, np.append(force, force[0]), color=colour, ls=style, lw=0.9, label=name)
        ax.set_title(_short(loop))
        if k == 0:
            handles, labels = ax.get_legend_handles_labels()
            figure.legend(handles, labels, loc="upper center", ncols=3)
        if k % _COLUMNS == 0:
            ax.set_ylabel("force, N")
        if k >= len(loops) - _COLUMNS:
            ax.set_xlabel("displacement, mm")
    return figure


@styled
def misfit_figure(loops: Sequence[Loop], models: Sequence[LoopModel]) -> Figure:
    """What the linear spring and the last model leave of the force, over the way up and the way down."""
    shown = _ends(models)
    figure = new_figure(2.7)
    grid = figure.add_gridspec(1, len(shown), wspace=0.22, **margins(figure, right=0.3))
    for c, model in enumerate(shown):
        ax = figure.add_subplot(grid[0, c])
        for i, (loop, fit) in enumerate(zip(loops, model.fits, strict=True)):
            half = 0.5 * float(np.ptp(loop.force))
            order = np.argsort((loop.phase - loop.phase[int(np.argmin(loop.displacement))]) % 1.0)
            left = 100 * (loop.force - fit.force)[order] / half
            where = np.linspace(0.0, 1.0, len(left))
            ax.plot(where, left, color=SERIES[i % len(SERIES)], ls=LINES[i % len(LINES)], lw=0.8)
        ax.axhline(0.0, color="#444444", lw=0.6)
        ax.axvline(0.5, color="#9a9a9a", lw=0.6, ls=":")
        ax.set_xlim(0.0, 1.0)
        ax.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0], ["bottom", "up", "top", "down", "bottom"])
        ax.set_title(_MODELS[c][2] if len(shown) > 1 else _MODELS[0][2])
        if c == 0:
            ax.set_ylabel("measured - model, % of force")
    return figure


_MODELS = ((GREY, "--", "linear spring"), (MODEL, "-", "last model of the ladder"))
_LONG = 24


def _ends(models: Sequence[LoopModel]) -> tuple[LoopModel, ...]:
    """The first model and the last, once where they are the same."""
    return tuple(models) if len(models) < 2 else (models[0], models[-1])


def _short(loop: Loop) -> str:
    name = loop.name.rsplit("/", 1)[-1].rsplit(".", 1)[0]
    values = f"{loop.frequency_hz:.3g} Hz, {1e3 * loop.amplitude_m:.3g} mm"
    return values if name in values or len(name) > _LONG else f"{name}\n{values}"


def _draw(ax: Axes, loop: Loop, fit: LoopFit) -> None:
    x = 1e3 * np.append(loop.displacement, loop.displacement[0])
    ax.plot(x, np.append(loop.force, loop.force[0]), color=MEASURED, label="measured")
    ax.plot(x, np.append(fit.force, fit.force[0]), color=MODEL, ls="--", label="model")
    ax.set_title(_short(loop))


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
        text = f"{1e3 * line.amplitude_m:.3g} mm: c = {format_value(c.value, c.std, 'N·s/m')}"
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
