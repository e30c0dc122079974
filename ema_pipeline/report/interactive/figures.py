"""The figures of the report and of the live page, without data: the page's script fills their sources by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

from bokeh.embed import json_item
from bokeh.layouts import column
from bokeh.models import (
    BasicTicker,
    ColumnDataSource,
    FactorRange,
    FixedTicker,
    LinearColorMapper,
    Range1d,
    TapTool,
)
from bokeh.models.annotations import ColorBar
from bokeh.palettes import Blues256

from ema_pipeline.report.interactive.loops import loops_figure, loss_figure
from ema_pipeline.report.interactive.packing import LEVELS
from ema_pipeline.report.interactive.theme import (
    ACCENT,
    AFTER,
    BEFORE,
    INK,
    INK_TAG,
    THIRD,
    hover,
    log_axis,
    new_figure,
    place_legend,
    source,
)


def frf_viewer(log_x: bool = False) -> Any:
    """Magnitude (two scales, one shown), phase and coherence of one FRF: measured with its band, and two models.

    Of several forces at once the multiple coherence is dashed beside the partial one.
    """
    x_type = "log" if log_x else "linear"
    measured = source("frf.measured", "f", "magnitude", "phase", "coherence", "multiple", "low", "high")
    models = [(source(f"frf.{k}", "f", "magnitude", "phase"), k) for k in ("before", "after")]
    levels = {name: source(f"frf.{name}", "f", "level", "floor") for name in LEVELS}
    modes = source("frf.modes", "f", "text")
    selected = source("frf.selected", "f")
    styles = {"before": (BEFORE, "dashed", "base model"), "after": (AFTER, "solid", "with effects")}
    x_range = Range1d(start=1, end=1000, name="frf.x")
    made = []
    for name, y_type in (("frf.log", "log"), ("frf.lin", "linear")):
        top = new_figure(
            "", "|accelerance|, (m/s²)/N", 330, x_axis_type=x_type, y_axis_type=y_type, x_range=x_range,
            y_range=Range1d(start=1e-3, end=1, name=f"{name}.y"), name=name, visible=name == "frf.log",
        )  # fmt: skip
        top.yaxis.name = f"{name}.axis"
        top.varea("f", "low", "high", source=measured, color=INK, alpha=0.22, legend_label="measured ± 2σ")
        _noise_and_distortion(top, levels)
        line = top.line("f", "magnitude", source=measured, color=INK, line_width=1.6, legend_label="measured")
        line.glyph.tags = [INK_TAG]
        for data, key in models:
            color, dash, label = styles[key]
            top.line(
                "f", "magnitude", source=data, color=color, line_width=1.7, line_dash=dash,
                legend_label=label, name=f"frf.{key}.line",
            )  # fmt: skip
        top.vspan("f", source=modes, line_color=INK, line_dash="dotted", line_alpha=0.55)
        top.vspan("f", source=selected, line_color=ACCENT, line_width=2, line_alpha=0.9)
        hover(top, [line], ("f", "@f{0.00} Hz"), ("measured", "@magnitude{0.0000e+0}"), mode="vline")
        place_legend(top)
        made.append(top)
    phase = new_figure(
        "", "phase, °", 150, x_axis_type=x_type, x_range=x_range, y_range=(-185, 185), name="frf.phase"
    )
    phase.yaxis.ticker = [-180, -90, 0, 90, 180]
    phase.line("f", "phase", source=measured, color=INK, line_width=1.4).glyph.tags = [INK_TAG]
    for data, key in models:
        phase.line("f", "phase", source=data, color=styles[key][0], line_width=1.5, line_dash=styles[key][1])
    coherence = new_figure(
        "frequency, Hz", "coherence, 1", 140, x_axis_type=x_type, x_range=x_range, y_range=(0, 1.05),
        name="frf.coherence",
    )  # fmt: skip
    coherence.line("f", "multiple", source=measured, color=ACCENT, line_width=1.2, line_dash="dashed")
    coherence.line("f", "coherence", source=measured, color=INK, line_width=1.2).glyph.tags = [INK_TAG]
    for one in (phase, coherence):
        one.vspan("f", source=modes, line_color=INK, line_dash="dotted", line_alpha=0.55)
    ticks = FixedTicker(name="frf.x.ticks")
    for one in (*made, phase, coherence):
        if one is not coherence:
            one.xaxis.axis_label = None
            one.xaxis.major_label_text_font_size = "0px"
        if log_x:
            log_axis(one.xaxis[0], ticks)
    return column(*made, phase, coherence, sizing_mode="stretch_width")


def _noise_and_distortion(top: Any, levels: Mapping[str, ColumnDataSource]) -> None:
    """What a multisine tells apart: bands up to 1 σ of noise and of distortion, marks at lines without force."""
    top.varea(
        "f", "floor", "level", source=levels["distortion"], fill_color=ACCENT, fill_alpha=0.12, hatch_pattern="/",
        hatch_color=ACCENT, hatch_alpha=0.5, legend_label="distortion",
        name="frf.level.distortion",
    )  # fmt: skip
    top.varea(
        "f", "floor", "level", source=levels["noise"], fill_color=INK, fill_alpha=0.3,
        legend_label="noise", name="frf.level.noise",
    )  # fmt: skip
    for name, marker, color in (("odd", "triangle", THIRD), ("even", "square", BEFORE)):
        top.scatter(
            "f", "level", source=levels[name], marker=marker, size=5, line_color=color, fill_color=None,
            legend_label=f"{name} lines", name=f"frf.level.{name}",
        )  # fmt: skip


def error_per_mode() -> Any:
    """Largest difference of every mode in σ: a wide hatched bar before, a narrow full bar after."""
    bars = source("errors.bars", "mode", "before", "after", "bottom", "text_before", "text_after", "what")
    lone = source("errors.lone", "mode", "z", "text")
    made = new_figure(
        "measured mode", "|measured − model| / σ", 330, y_axis_type="log", x_range=FactorRange(name="errors.x"),
        y_range=Range1d(start=0.1, end=10, name="errors.y"), tools="save,reset,pan,xwheel_zoom",
    )  # fmt: skip
    before = made.vbar(
        "mode", 0.78, "before", "bottom", source=bars, fill_color=BEFORE, fill_alpha=0.2, line_color=BEFORE,
        hatch_pattern="/", hatch_color=BEFORE, hatch_alpha=0.6, legend_label="base model", name="errors.before",
    )  # fmt: skip
    after = made.vbar(
        "mode",
        0.4,
        "after",
        "bottom",
        source=bars,
        color=AFTER,
        legend_label="with effects",
        name="errors.after",
    )
    cross = made.scatter("mode", "z", source=lone, marker="x", size=12, color=INK, line_width=2)
    cross.glyph.tags = [INK_TAG]
    made.hspan([2], line_color=INK, line_dash="dashed", line_width=1)
    made.xaxis.major_label_orientation = 1.2
    log_axis(made.yaxis[0], FixedTicker(name="errors.y.ticks"))
    hover(made, [before, after], ("mode", "@mode"), ("before", "@text_before"), ("after", "@text_after"))
    hover(made, [cross], ("mode", "@mode"), ("model", "@text"))
    place_legend(made)
    return made


def moved() -> Any:
    """How far parts and parameters had to move from what is stated, in σ: hatched before, full after."""
    bars = source("moved.bars", "name", "before", "after", "text_before", "text_after")
    made = new_figure(
        "distance from what is stated / σ", "", 340, y_range=FactorRange(name="moved.y"),
        x_range=Range1d(start=0, end=5, name="moved.x"), tools="save",
    )  # fmt: skip
    before = made.hbar(
        "name", 0.78, "before", source=bars, fill_color=BEFORE, fill_alpha=0.2, line_color=BEFORE,
        hatch_pattern="/", hatch_color=BEFORE, hatch_alpha=0.6, legend_label="base model", name="moved.before",
    )  # fmt: skip
    after = made.hbar(
        "name", 0.4, "after", source=bars, color=AFTER, legend_label="with effects", name="moved.after"
    )
    made.vspan([3], line_color=INK, line_dash="dashed", line_width=1)
    hover(made, [before, after], ("", "@name"), ("before", "@text_before"), ("after", "@text_after"))
    place_legend(made)
    return made


def ladder() -> Any:
    """Error of every model on the data fitted and on data held out."""
    data = source("ladder.rungs", "model", "error", "held", "words")
    made = new_figure(
        "", "error, σ", 300, x_range=FactorRange(name="ladder.x"), y_range=Range1d(start=0, end=3, name="ladder.y"),
        tools="save",
    )  # fmt: skip
    made.hspan([1], line_color=INK, line_dash="dotted", line_width=1.5)
    made.line("model", "error", source=data, color=AFTER, line_width=2, legend_label="data fitted")
    fitted = made.scatter("model", "error", source=data, color=AFTER, size=9, legend_label="data fitted")
    made.line(
        "model", "held", source=data, color=BEFORE, line_width=2, line_dash="dashed", legend_label="held out"
    )
    held = made.scatter(
        "model", "held", source=data, marker="square", line_color=BEFORE, fill_color="white", size=9,
        line_width=2, legend_label="held out",
    )  # fmt: skip
    hover(made, [fitted, held], ("model", "@words"), ("error", "@error{0.000}"), ("held out", "@held{0.000}"))
    made.xaxis.major_label_text_font_size = "11px"
    place_legend(made)
    return made


def nyquist() -> Any:
    """Nyquist circle of one mode in one FRF."""
    points = source("nyquist.points", "re", "im", "f")
    made = new_figure(
        "Re mobility, (m/s)/N", "Im mobility, (m/s)/N", 360, match_aspect=True, name="nyquist.figure"
    )
    made.xaxis.name, made.yaxis.name = "nyquist.x_axis", "nyquist.y_axis"
    circle = source("nyquist.circle", "re", "im")
    marks = source("nyquist.marks", "re", "im", "text")
    made.line(
        "re",
        "im",
        source=circle,
        color=BEFORE,
        line_dash="dashed",
        line_width=1.8,
        legend_label="fitted circle",
    )
    dots = made.scatter("re", "im", source=points, color=AFTER, size=7, legend_label="measured lines")
    stars = made.scatter(
        "re", "im", source=marks, marker="diamond", size=14, fill_color=None, line_color=INK, line_width=2,
        legend_label="pole", name="nyquist.pole",
    )  # fmt: skip
    stars.glyph.tags = [INK_TAG]
    hover(made, [dots], ("f", "@f{0.000} Hz"))
    place_legend(made)
    return made


def stabilisation(log_x: bool = False) -> Any:
    """Poles of all model orders over the mode indicator."""
    made = new_figure(
        "frequency, Hz", "model order", 360, x_axis_type="log" if log_x else "linear",
        x_range=Range1d(start=1, end=1000, name="stab.x"), y_range=Range1d(start=0, end=10, name="stab.y"),
    )  # fmt: skip
    if log_x:
        log_axis(made.xaxis[0], FixedTicker(name="stab.x.ticks"))
    cmif = source("stab.cmif", "f", "y")
    made.line(
        "f", "y", source=cmif, color=INK, alpha=0.5, line_width=1.2, legend_label="mode indicator (log)"
    ).glyph.tags = [INK_TAG]
    shown = []
    for key, marker, color, label in (
        ("loose", "x", INK, "not stable"),
        ("stable", "circle", THIRD, "stable"),
        ("voted", "square", AFTER, "stands for a mode"),
    ):
        data = source(f"stab.{key}", "f", "order", "damping")
        shown.append(
            made.scatter(
                "f",
                "order",
                source=data,
                name=f"stab.poles.{key}",
                marker=marker,
                size=6,
                line_color=color,
                legend_label=label,
                fill_color=color if key == "voted" else None,
                selection_line_color=ACCENT,
                nonselection_alpha=1,
            )
        )
    made.vspan("f", source=source("stab.selected", "f"), line_color=ACCENT, line_width=2)
    shown[0].glyph.tags = [INK_TAG]
    made.add_tools(TapTool(renderers=[*shown], mode="replace"))
    hover(made, shown, ("f", "@f{0.00} Hz"), ("order", "@order"), ("damping", "@damping{0.00} %"))
    place_legend(made)
    return made


def mac() -> Any:
    """MAC matrix."""
    cells = source("mac.cells", "x", "y", "value", "text", "label")
    mapper = LinearColorMapper(palette=Blues256[::-1], low=0, high=1)
    made = new_figure(
        "model mode, Hz", "measured mode, Hz", 420, x_range=FactorRange(name="mac.x"),
        y_range=FactorRange(name="mac.y"), tools="save,reset,pan,wheel_zoom",
    )  # fmt: skip
    rects = made.rect(
        "x",
        "y",
        0.96,
        0.96,
        source=cells,
        fill_color={"field": "value", "transform": mapper},
        line_color=None,
    )
    made.rect(
        "x",
        "y",
        0.96,
        0.96,
        source=source("mac.pairs", "x", "y"),
        fill_color=None,
        line_color=BEFORE,
        line_width=2,
    )
    made.xaxis.major_label_orientation = 1.2
    made.xaxis.name, made.yaxis.name = "mac.x_axis", "mac.y_axis"
    made.add_layout(ColorBar(color_mapper=mapper, ticker=BasicTicker(desired_num_ticks=5), width=10), "right")
    hover(made, [rects], ("modes", "@label"), ("MAC", "@value{0.000}"))
    return made


def shape() -> Any:
    """One measured shape over the DOFs, with the model's beside it."""
    measured = source("shape.measured", "dof", "value", "low", "high", "zero")
    model = source("shape.model", "dof", "value")
    made = new_figure(
        "", "shape, 1", 300, x_range=FactorRange(name="shape.x"), y_range=(-1.25, 1.25),
        tools="save,reset,pan,xwheel_zoom",
    )  # fmt: skip
    made.hspan([0], line_color=INK)
    made.segment("dof", "zero", "dof", "value", source=measured, color=AFTER, line_width=2)
    made.segment("dof", "low", "dof", "high", source=measured, color=INK, line_width=5, alpha=0.5)
    dots = made.scatter("dof", "value", source=measured, size=7, color=AFTER, legend_label="measured ± 1σ")
    made.scatter(
        "dof", "value", source=model, marker="x", size=9, color=BEFORE, line_width=2, legend_label="model"
    )
    made.xaxis.major_label_orientation = 1.2
    hover(made, [dots], ("", "@dof"), ("", "@value{0.000}"))
    place_legend(made)
    return made


def levels() -> Any:
    """Frequency of every mode over the force, relative to the softest level."""
    lines = source("levels.lines", "xs", "ys", "text", "color", "width")
    made = new_figure("force, N", "change of frequency, %", 300)
    curves = made.multi_line("xs", "ys", source=lines, line_color="color", line_width="width")
    dots = source("levels.points", "x", "y", "low", "high", "text", "color")
    made.segment("x", "low", "x", "high", source=dots, color="color")
    points = made.scatter("x", "y", source=dots, color="color", size=7)
    hover(made, [curves, points], ("", "@text"))
    return made


def sweeps() -> Any:
    """The error function over one stiffness, per configuration and number of modes."""
    made = new_figure("stiffness, N/m", "error function ε", 360, x_axis_type="log", y_axis_type="log")
    lines = source("sweeps.lines", "xs", "ys", "text", "color", "dash")
    curves = made.multi_line(
        "xs", "ys", source=lines, line_color="color", line_dash="dash", line_width=2, legend_field="text"
    )
    hover(made, [curves], ("", "@text"))
    place_legend(made)
    made.legend.ncols = 2
    made.legend.click_policy = "none"  # one renderer draws all curves
    return made


_FIGURES: dict[str, Callable[[], Any]] = {
    "errors": error_per_mode,
    "moved": moved,
    "ladder": ladder,
    "nyquist": nyquist,
    "mac": mac,
    "shape": shape,
    "levels": levels,
    "sweeps": sweeps,
    "loops": loops_figure,
    "loss": loss_figure,
}


def figure_items(names: list[str], log_x: bool) -> dict[str, Any]:
    """Documents of the named figures, as BokehJS embeds them."""
    return {name: _item(name, log_x) for name in names}


@cache
def _item(name: str, log_x: bool) -> Any:
    """Document of one figure, made once in a process: it holds no data, and a report is half made of making them."""
    makers = _FIGURES | {"frf": partial(frf_viewer, log_x), "stab": partial(stabilisation, log_x)}
    return json_item(makers[name]())
