"""Dependence on the force: every mode by level, and one sheet per mode that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray

from ema_pipeline.levels.types import DecayCurve, LevelStudy, ModeLevels
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import plain
from ema_pipeline.report.style import (
    BLUE,
    GREY,
    LINES,
    MARKERS,
    ORANGE,
    PURPLE,
    SERIES,
    SKY,
    VERMILLION,
    log_y,
    margins,
    new_figure,
    note,
    styled,
)

LEVEL_COLOURS = (SKY, BLUE, PURPLE, VERMILLION, ORANGE)
"""From soft to hard; beyond these the usual series."""

REACH = 4.0
"""Half-power half-widths shown on either side of a mode."""

Real = NDArray[np.float64]


def level_style(k: int) -> tuple[str, str, object]:
    """Colour, marker and line style of a level."""
    colours = (*LEVEL_COLOURS, *SERIES)
    return colours[k % len(colours)], MARKERS[k % len(MARKERS)], LINES[k % len(LINES)]


@styled
def all_modes(study: LevelStudy, modal: ModalModel) -> Figure:
    """Change of every mode from the softest level, in half-power half-widths and in percent of its damping.

    Parameters
    ----------
    study : LevelStudy
        Of several levels.
    modal : ModalModel
    """
    shown = [m for m in study.modes if m.frequency_shift_hz is not None and np.isfinite(m.frequency_p)]
    height = 1.1 + 0.3 * max(len(shown), 3)
    figure = new_figure(height)
    grid = figure.add_gridspec(1, 2, wspace=0.08, **margins(figure, left=1.1, top=0.62))
    first = figure.add_subplot(grid[0, 0])
    axes = (first, figure.add_subplot(grid[0, 1], sharey=first))
    axes[1].tick_params(labelleft=False)
    for ax, kind in zip(axes, ("frequency", "damping"), strict=True):
        ax.axvline(0, color=GREY, lw=0.8)
        for row, m in enumerate(shown):
            mode = modal.modes[m.mode]
            for k in range(1, len(study.levels)):
                shift, std = _shift(m, k, kind, mode.frequency_hz, mode.damping_ratio)
                colour, marker, _ = level_style(k)
                ax.errorbar(
                    shift, row + 0.16 * (k - len(study.levels) / 2), xerr=std, fmt=marker, color=colour, ms=4,
                    lw=1, capsize=2, label=f"{study.levels[k].label}" if row == 0 else None,
                )  # fmt: skip
        ax.margins(x=0.08)
        ax.xaxis.set_major_locator(MaxNLocator(6))
    axes[0].set_yticks(
        range(len(shown)),
        [
            f"{'! ' if m.depends else ''}{m.mode + 1}: {modal.modes[m.mode].frequency_hz:.5g} Hz"
            for m in shown
        ],
    )
    axes[0].set_ylim(len(shown) - 0.4, -0.6)
    axes[0].set_xlabel("change of frequency, half-widths ζf")
    axes[1].set_xlabel("change of damping ratio, %")
    figure.suptitle(
        f"Change from {study.levels[0].label} (±1σ; ! moves beyond chance)",
        y=1 - 0.1 / height, fontsize=9, fontweight="bold",
    )  # fmt: skip
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper center", ncols=6, frameon=False, bbox_to_anchor=(0.5, 1 - 0.24 / height)
    )
    if not shown:
        note(axes[0], "no mode could be tested")
    return figure


def _shift(mode: ModeLevels, k: int, kind: str, frequency_hz: float, damping: float) -> tuple[float, float]:
    """Change and its standard deviation in half-widths, or in percent of the damping ratio."""
    if kind == "frequency":
        assert mode.frequency_shift_hz is not None
        assert mode.frequency_shift_std_hz is not None
        unit = frequency_hz * damping
        return float(mode.frequency_shift_hz[k] / unit), float(mode.frequency_shift_std_hz[k] / unit)
    assert mode.damping_shift is not None
    assert mode.damping_shift_std is not None
    return float(100 * mode.damping_shift[k] / damping), float(100 * mode.damping_shift_std[k] / damping)


@styled
def moving_mode(study: LevelStudy, modal: ModalModel, index: int) -> Figure:
    """One mode that moves: over force, as FRF and circle by level, and over amplitude in its decays.

    Parameters
    ----------
    study : LevelStudy
    modal : ModalModel
    index : int
        Into `study.modes`.
    """
    mode = study.modes[index]
    curves = [c for c in study.decays if c.mode == mode.mode]
    several = len(study.levels) > 1
    rows = 2 * several + bool(curves)
    height = 0.7 + 2.35 * max(rows, 1)
    figure = new_figure(height)
    grid = figure.add_gridspec(
        max(rows, 1), 2, hspace=0.42, wspace=0.33, **margins(figure, left=0.75, top=0.42)
    )
    name = f"Mode {mode.mode + 1}, {modal.modes[mode.mode].frequency_hz:.5g} Hz"
    figure.suptitle(
        f"{name}: {mode.trend or 'nothing moves'}", y=1 - 0.1 / height, fontsize=9, fontweight="bold"
    )
    if several:
        _over_force(figure.add_subplot(grid[0, 0]), study, mode, "frequency")
        _over_force(figure.add_subplot(grid[0, 1]), study, mode, "damping")
        _frfs(figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1]), study, modal, mode)
    if curves:
        _decay(figure.add_subplot(grid[rows - 1, 0]), curves, "frequency")
        _decay(figure.add_subplot(grid[rows - 1, 1]), curves, "damping")
    return figure


def _over_force(ax: Axes, study: LevelStudy, mode: ModeLevels, kind: str) -> None:
    force = np.array([level.force_n for level in study.levels])
    if kind == "frequency":
        values, stds, factor = mode.frequency_hz, mode.frequency_std_hz, 1.0
        shift, shift_std = mode.frequency_shift_hz, mode.frequency_shift_std_hz
        ax.set_ylabel("natural frequency, Hz")
    else:
        values, stds, factor = mode.damping_ratio, mode.damping_std, 100.0
        shift, shift_std = mode.damping_shift, mode.damping_shift_std
        ax.set_ylabel("damping ratio, %")
    ax.errorbar(
        force * 0.97,
        factor * values,
        yerr=factor * stds,
        fmt="o-",
        color=BLUE,
        capsize=3,
        label="FRFs of the level",
    )
    if shift is not None and shift_std is not None and np.isfinite(values[0]):
        ax.errorbar(
            force * 1.03, factor * (values[0] + shift), yerr=factor * shift_std, fmt="s--", color=VERMILLION,
            capsize=3, label="single hits, each on its own point",
        )  # fmt: skip
    known = [factor * values, factor * stds]
    if shift is not None and shift_std is not None:
        known = [np.append(known[0], factor * (values[0] + shift)), np.append(known[1], factor * shift_std)]
    _limit(ax, known[0], known[1])
    ax.set_xscale("log")
    ax.set_xticks(force, [f"{f:.3g}" for f in force])
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlim(force[0] / 1.3, force[-1] * 1.3)
    ax.yaxis.set_major_locator(MaxNLocator(5))
    ax.ticklabel_format(axis="y", useOffset=False)
    ax.set_xlabel("peak force, N")
    ax.legend(loc="best")


def _frfs(left: Axes, right: Axes, study: LevelStudy, modal: ModalModel, mode: ModeLevels) -> None:
    """Magnitude and Nyquist plot of the FRF that differs most between the levels."""
    pole = modal.modes[mode.mode]
    best = _most_different(study, pole.frequency_hz, pole.frequency_hz * pole.damping_ratio)
    if best is None:
        for ax in (left, right):
            ax.set_axis_off()
        note(left, "no FRF was measured at several levels")
        return
    output, source = best
    for k, level in enumerate(study.levels):
        f = level.frfs
        o = next((j for j, d in enumerate(f.outputs) if d.point == output), None)
        i = next((j for j, d in enumerate(f.inputs) if d.point == source), None)
        if o is None or i is None or not f.hits[o, i]:
            continue
        lines = _lines(f.frequency_hz, pole.frequency_hz, pole.frequency_hz * pole.damping_ratio)
        acceleration = f.accelerance(lines)[o, i]
        mobility = acceleration / (2j * np.pi * f.frequency_hz[lines])
        colour, marker, line = level_style(k)
        label = f"{level.label}"
        left.plot(
            f.frequency_hz[lines],
            np.abs(acceleration),
            ls=line,
            marker=marker,
            ms=2.5,
            color=colour,
            label=label,
        )
        right.plot(
            mobility.real, mobility.imag, ls=line, marker=marker, ms=3, lw=0.8, color=colour, label=label
        )
    unit = "(m/s²)/N" if study.levels[0].frfs.force_calibrated else "(m/s²)/V"
    log_y(left)
    left.set_xlabel("frequency, Hz")
    left.set_ylabel(f"|{output} ← {source}|, {unit}")
    left.legend(loc="best")
    right.set_aspect("equal", adjustable="datalim")
    right.set_xlabel("Re mobility, (m/s)/N")
    right.set_ylabel("Im mobility, (m/s)/N")
    right.ticklabel_format(style="sci", scilimits=(-2, 3))
    right.legend(loc="best")


def _lines(axis: Real, frequency_hz: float, half_hz: float) -> slice:
    reach = max(REACH * half_hz, 8 * float(axis[1]))
    first, stop = np.searchsorted(axis, [frequency_hz - reach, frequency_hz + reach])
    return slice(max(int(first), 1), int(stop))


def _most_different(study: LevelStudy, frequency_hz: float, half_hz: float) -> tuple[str, str] | None:
    """Output and input of the FRF that differs most, over its own size, between softest and hardest level."""
    soft, hard = study.levels[0].frfs, study.levels[-1].frfs
    lines = _lines(soft.frequency_hz, frequency_hz, half_hz)
    a, b = (np.nan_to_num(f.accelerance(lines)) for f in (soft, hard))
    best, score = None, 0.0
    for o, output in enumerate(soft.outputs):
        for i, source in enumerate(soft.inputs):
            if output not in hard.outputs or source not in hard.inputs:
                continue
            one, two = a[o, i], b[hard.outputs.index(output), hard.inputs.index(source)]
            if not (np.any(one) and np.any(two)):
                continue
            size = float(np.sum(np.abs(one - two) ** 2))
            if size > score:
                best, score = (output.point, source.point), size
    return best


def _decay(ax: Axes, curves: Sequence[DecayCurve], kind: str) -> None:
    shown, errors = [], []
    for k, c in enumerate(curves):
        colour, marker, line = level_style(k)
        if kind == "frequency":
            values, stds = c.frequency_hz, c.frequency_std_hz
        else:
            values, stds = 100 * c.damping_ratio, 100 * c.damping_std
        shown.append(values)
        errors.append(stds)
        ax.errorbar(
            c.amplitude_m * 1e6, values, yerr=stds, marker=marker, ls=line, color=colour, ms=4, capsize=2, lw=1,
            label=f"{c.hit.rpartition('.')[0] or c.hit}, {c.output.point}",
        )  # fmt: skip
    ax.set_xscale("log")
    ax.set_xlabel("displacement amplitude while it decays, µm")
    ax.set_ylabel("instantaneous frequency, Hz" if kind == "frequency" else "instantaneous damping ratio, %")
    ax.ticklabel_format(axis="y", useOffset=False)
    ax.yaxis.set_major_locator(MaxNLocator(5))
    _limit(ax, np.concatenate(shown), np.concatenate(errors))
    if kind == "frequency":
        ax.legend(loc="best", fontsize=6)


def _limit(ax: Axes, values: Real, stds: Real) -> None:
    """Show the values that are known well; the error bars of the others may leave the axes."""
    use = np.isfinite(values) & np.isfinite(stds)
    if not use.any():
        return
    values, stds = values[use], stds[use]
    known = stds <= max(5 * float(np.median(stds)), 0.3 * float(np.ptp(values)))
    low, high = float((values - 1.5 * stds)[known].min()), float((values + 1.5 * stds)[known].max())
    low, high = min(low, float(values.min())), max(high, float(values.max()))
    margin = 0.12 * (high - low)
    if margin > 0:
        ax.set_ylim(low - margin, high + margin)


def caption(study: LevelStudy, modal: ModalModel, index: int) -> str:
    """What a mode's sheet shows, in words."""
    mode = study.modes[index]
    where = f"mode {mode.mode + 1} at {plain(modal.modes[mode.mode].frequency_hz, 5)} Hz"
    parts = (
        "frequency and damping over force, FRF and Nyquist circle by level, " if len(study.levels) > 1 else ""
    )
    return f"What moves in {where}: {parts}backbone and damping over amplitude from decays"
