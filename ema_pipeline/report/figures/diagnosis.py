"""The diagnosis in pictures: where the model fails, what may be missing, and the error rung by rung."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ema_pipeline.correlate.types import Comparison, ModeDifference, Unpaired
from ema_pipeline.diagnose.sentences import probability_text
from ema_pipeline.diagnose.types import Diagnosis, Ladder, Rung
from ema_pipeline.number_text import plain
from ema_pipeline.report.diagnosis import NOTHING, label_words, rung_words
from ema_pipeline.report.figures.comparison import severity, worst_per_body
from ema_pipeline.report.figures.shapes import draw_rig
from ema_pipeline.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    VERMILLION,
    WIDTH_IN,
    margins,
    new_figure,
    note,
    styled,
)
from ema_pipeline.rigs.drawing import Drawing

HALF_IN = 3.55
"""Width of figures that stand side by side."""

RUNGS_IN_HALF = 4
MODES_SHOWN = 40
_FLOOR = 0.5
_LONE: Any = {"fc": "white", "ec": BLACK, "hatch": "xxxx", "lw": 0.4}
_QUANTITIES = (
    ("frequency", "frequency_z", BLUE, ""),
    ("damping", "damping_z", GREEN, "///"),
    ("shape", "shape_z", VERMILLION, "..."),
)


@styled
def candidate_probabilities(found: Diagnosis) -> Figure:
    """Probabilities of the candidates, of all others together, and of nothing missing.

    What the data support has a full bar and says so; the rest is hatched.
    """
    bars = [(label_words(c.label), c.probability, c.claimed) for c in found.candidates]
    listed = {c.label for c in found.candidates} | {NOTHING}
    others = [p for label, p in found.probabilities.items() if label not in listed]
    if others:
        name = "1 other" if len(others) == 1 else f"{len(others)} others together"
        bars.append((name, math.fsum(others), False))
    bars.append(("nothing missing at all", found.null_probability, found.verdict == "adequate"))
    figure = new_figure(0.75 + 0.235 * max(len(bars), 7), HALF_IN)
    ax = figure.add_subplot(
        figure.add_gridspec(1, 1, **margins(figure, left=1.42, right=0.1, bottom=0.42))[0]
    )
    at = np.arange(len(bars))
    for k, (_, p, supported) in enumerate(bars):
        ax.barh(
            k,
            p,
            0.62,
            fc=BLUE if supported else "#ffffff",
            ec=BLUE if supported else GREY,
            hatch="" if supported else "////",
            lw=0.8,
        )
        text = probability_text(p) + (" ◆" if supported else "")
        inside = p > 0.6
        ax.text(
            0.03 if inside else p + 0.02,
            k,
            text,
            ha="left",
            va="center",
            fontsize=7,
            fontweight="bold" if supported else "normal",
            color="white" if inside and supported else BLACK,
            bbox={"fc": "white", "ec": "none", "pad": 0.8} if not (inside and supported) else None,
        )
    ax.set_title("Probability (◆ supported by the data)", x=-0.62, ha="left", fontsize=7.6)
    ax.set_yticks(at, [textwrap.fill(name, 29, break_on_hyphens=False) for name, _, _ in bars], fontsize=6.2)
    ax.set_ylim(len(bars) - 0.4, -0.6)
    ax.set_xlim(0, 1)
    ax.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "0.25", "0.5", "0.75", "1"])
    ax.set_xlabel("probability, 1")
    ax.grid(False, axis="y")
    return figure


@styled
def ladder_errors(ladder: Ladder) -> Figure:
    """Error on the data fitted and on data held out, from the base model upwards."""
    rungs = ladder.rungs
    width = HALF_IN if len(rungs) <= RUNGS_IN_HALF else WIDTH_IN
    wide = max(9, round(12.4 * width) // len(rungs))
    befores: list[tuple[str, ...]] = [(), *(r.effects for r in rungs[:-1])]
    labels = [_rung_label(b, r, wide) for b, r in zip(befores, rungs, strict=True)]
    lines = max(label.count("\n") + 1 for label in labels)
    figure = new_figure(2.14 + 0.1 * max(lines, 3), width)
    ax = figure.add_subplot(
        figure.add_gridspec(1, 1, **margins(figure, left=0.55, right=0.1, bottom=0.5 + 0.1 * max(lines, 3)))[
            0
        ]
    )
    at = np.arange(len(rungs))
    fitted = np.array([r.error for r in rungs], dtype=float)
    held = np.array([r.heldout_error for r in rungs], dtype=float)
    every = np.concatenate([fitted, held])
    every = every[np.isfinite(every) & (every > 0)]
    low, high = min([0.7, *every]), max([3.0, *every])
    room = (high / low) ** 0.16  # for the numbers beside the points
    low, high = low / room, high * room
    ax.axhline(1.0, color=BLACK, lw=0.9, ls=":", label="about 1: explained")
    ax.plot(at - 0.04, fitted, "o-", color=BLUE, label="data fitted", ms=5)
    ax.plot(at + 0.04, held, "s--", color=VERMILLION, label="data held out", ms=5, mfc="white")
    for k in range(len(rungs)):
        for value, other, side in ((fitted[k], held[k], -1), (held[k], fitted[k], 1)):
            if not np.isfinite(value):
                continue
            # the larger of the two is written above, the smaller below
            above = value > other or (value == other and side > 0) or not np.isfinite(other)
            ax.annotate(
                plain(float(value), 3),
                (k + 0.04 * side, value),
                (0, 5 if above else -5),
                textcoords="offset points",
                ha="center",
                va="bottom" if above else "top",
                fontsize=6.5,
                color=BLUE if side < 0 else VERMILLION,
                bbox={"fc": "white", "ec": "none", "pad": 0.4, "alpha": 0.8},
            )
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    _plain_log(ax, low, high)
    ax.set_xlim(-0.5, len(rungs) - 0.5)
    ax.set_xticks(at, labels, fontsize=6)
    ax.grid(False, axis="x")
    ax.set_ylabel("error, σ root mean square")
    ax.set_title("Error rung by rung", loc="left")
    figure.legend(
        loc="lower center", ncols=3, frameon=False, handlelength=2.4, columnspacing=1.0, fontsize=6.5
    )
    return figure


def _rung_label(before: tuple[str, ...], rung: Rung, width: int) -> str:
    text = textwrap.fill(rung_words(before, rung.effects), width, break_on_hyphens=False)
    if not rung.unexplained:
        return text
    left = f"{rung.unexplained} mode{'' if rung.unexplained == 1 else 's'} unexplained"
    return f"{text}\n{textwrap.fill(left, width)}"


@styled
def where_it_fails(
    before: Comparison,
    drawings: Sequence[Drawing | None],
    lone: Mapping[str, Sequence[Unpaired]],
    after: Comparison | None = None,
) -> Figure:
    """The largest difference of every mode, and the shape's misfit on the rig's drawing.

    Parameters
    ----------
    before : Comparison
        Of the model that was diagnosed.
    drawings : sequence of Drawing or None
        One per configuration; the one with most bodies is drawn, if there is one.
    lone : mapping of configuration to Unpaired
        Measured modes without a partner in the model: bars to the top.
    after : Comparison or None
        Of the model with what was found; drawn as hollow diamonds.
    """
    drawing = max((d for d in drawings if d is not None), key=lambda d: len(d.bodies), default=None)
    figure = new_figure(2.35)
    width, height = figure.get_size_inches()
    right = 2.35 if drawing is not None and before.dofs else 0.1
    ax = figure.add_axes(
        (0.55 / width, 0.62 / height, (width - 0.55 - right) / width, (height - 1.08) / height)
    )
    bars = _bars(before.modes, lone)
    _mode_bars(ax, bars, {} if after is None else {_key(m): _worst(m)[0] for m in after.modes})
    handles: list[Artist] = [Patch(fc=c, hatch=h, ec="white", label=name) for name, _, c, h in _QUANTITIES]
    if any(b.quantity < 0 for b in bars):
        handles.append(Patch(label="no partner", **_LONE))
    if after is not None:
        (mark,) = ax.plot([], [], "D", mfc="white", mec=BLACK, ms=3.6, label="with it added")
        handles.append(mark)
    figure.legend(
        handles=[*handles, Patch(fc="#efefef", label="chance (2σ)")],
        loc="upper left",
        bbox_to_anchor=(0.06, 1.0),
        ncols=len(handles) + 1,
        frameon=False,
        columnspacing=0.8,
        handletextpad=0.4,
        fontsize=6.2,
    )
    if drawing is not None and before.dofs:
        rig = figure.add_axes(((width - right + 0.1) / width, 0.03, (right - 0.1) / width, 0.87))
        _body_misfit(rig, drawing, worst_per_body(before.dofs))
    return figure


@dataclass(frozen=True)
class _Bar:
    """A measured mode; `quantity` points into `_QUANTITIES`, `size` is infinite without a partner."""

    configuration: str
    measured: int
    frequency_hz: float
    size: float
    quantity: int = -1


def _bars(modes: Sequence[ModeDifference], lone: Mapping[str, Sequence[Unpaired]]) -> list[_Bar]:
    """All measured modes, configuration by configuration, in order of frequency."""
    paired = [_Bar(m.configuration, m.measured, m.measured_frequency_hz, *_worst(m)) for m in modes]
    alone = [_Bar(name, u.index, u.frequency_hz, math.inf) for name, us in lone.items() for u in us]
    order = list(dict.fromkeys([*(m.configuration for m in modes), *lone]))
    return sorted([*paired, *alone], key=lambda b: (order.index(b.configuration), b.frequency_hz))


def _mode_bars(ax: Axes, bars: Sequence[_Bar], after: Mapping[tuple[str, int], float]) -> None:
    worst = sorted(bars, key=lambda b: -b.size)[:MODES_SHOWN]
    shown = [b for b in bars if b in worst]
    at, x = [], 0.0
    for k, b in enumerate(shown):
        x += 1.2 if k and b.configuration != shown[k - 1].configuration else 0.0
        at.append(x)
        x += 1.0
    sizes = [b.size for b in shown if math.isfinite(b.size)]
    high = 1.6 * max([12.5, *sizes, *after.values()])
    ax.axhspan(_FLOOR, 2, color="#efefef", lw=0, zorder=0)
    for place, b in zip(at, shown, strict=True):
        if b.quantity < 0:
            ax.bar(place, high - _FLOOR, 0.8, bottom=_FLOOR, **_LONE)
            continue
        _, _, color, hatch = _QUANTITIES[b.quantity]
        tall = max(b.size, 1.05 * _FLOOR) - _FLOOR
        ax.bar(place, tall, 0.8, bottom=_FLOOR, color=color, hatch=hatch, ec="white", lw=0.3)
        if (b.configuration, b.measured) in after:
            left = max(after[b.configuration, b.measured], 1.1 * _FLOOR)
            ax.plot(place, left, "D", mfc="white", mec=BLACK, ms=3.6, zorder=4)
    if all(b.size < _FLOOR for b in shown):
        note(ax, f"all differences are under {_FLOOR:g}σ")
    for name in dict.fromkeys(b.configuration for b in shown):
        start = next(p for p, b in zip(at, shown, strict=True) if b.configuration == name)
        ax.text(start - 0.4, 1.01, name, transform=ax.get_xaxis_transform(), fontsize=7, fontweight="bold")
    ax.set_yscale("log")
    ax.set_ylim(_FLOOR, high)
    _plain_log(ax, _FLOOR, high)
    ax.set_xlim(-0.8, max(x - 0.2, 1.0))
    ax.set_xticks(at, [f"{b.frequency_hz:.4g}" for b in shown], rotation=90, fontsize=5.8)
    ax.grid(False, axis="x")
    cut = f" (worst {len(shown)} of {len(bars)})" if len(shown) < len(bars) else ""
    ax.set_xlabel(f"measured mode{cut}, Hz")
    ax.set_ylabel("largest |difference|/σ, 1")


def _body_misfit(ax: Axes, drawing: Drawing, worst: Mapping[str, float]) -> None:
    norm, colours = severity()
    fills = {
        b.name: to_hex(colours(norm(worst[b.name]))) if b.name in worst else "#ffffff" for b in drawing.bodies
    }
    draw_rig(ax, drawing, drawing.at_rest(), 0.0, fills)
    top = max([5.0, *worst.values()])
    for b in drawing.bodies:
        if b.name not in worst:
            continue
        x, y = b.label_at
        z = worst[b.name]
        ax.plot(x, y, "o", ms=11 + 13 * min(z / top, 1.0), mfc=fills[b.name], mec=BLACK, mew=0.7, zorder=6)
        ax.text(
            x, y, f"{z:.1f}", ha="center", va="center", fontsize=6.4, zorder=7,
            color="white" if float(norm(z)) > 0.62 * colours.N else BLACK,
        )  # fmt: skip
    ax.set_title("Shape misfit per body, σ", fontsize=7.6, pad=1)
    ax.text(
        0.5, 0.0, "larger and darker: worse; white: not measured", transform=ax.transAxes, ha="center",
        va="bottom", fontsize=5.8, color=GREY,
    )  # fmt: skip


def _worst(m: ModeDifference) -> tuple[float, int]:
    """Largest of the three differences in σ, and which of `_QUANTITIES` it is."""
    sizes = [abs(v) if math.isfinite(v) else 0.0 for v in (m.frequency_z, m.damping_z, m.shape_z)]
    at = int(np.argmax(sizes))
    return sizes[at], at


def _key(m: ModeDifference) -> tuple[str, int]:
    return m.configuration, m.measured


def _plain_log(ax: Axes, low: float, high: float) -> None:
    """Plain numbers on a logarithmic y axis, never crowded."""
    decades = math.log10(high / low)
    steps = (1, 2, 5) if decades < 2.2 else (1, 3) if decades < 3 else (1,)
    ticks = [s * 10.0**p for p in range(-3, 9) for s in steps]
    ax.yaxis.set_major_locator(FixedLocator([t for t in ticks if low <= t <= high]))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
