"""How all interactive figures look."""

from __future__ import annotations

from typing import Any, Literal

from bokeh.models import BasicTickFormatter, ColumnDataSource, FixedTicker, HoverTool
from bokeh.plotting import figure

INK = "#5b6570"
"""Lines and labels; the page's script replaces it by the page's own ink, dark or light."""

BEFORE, AFTER, THIRD, ACCENT = "#D55E00", "#2583BE", "#009E73", "#CC79A7"
"""Base model, model with effects, and two more; told apart by the colour-blind too."""

INK_TAG = "ink"
"""Tag of glyphs that are drawn in the page's ink."""

_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"


def new_figure(x_label: str, y_label: str, height: int = 300, **options: Any) -> figure:
    """A figure as wide as the page allows; tools appear with the pointer.

    Parameters
    ----------
    x_label, y_label : str
    height : int
        Pixels.
    **options
        For `bokeh.plotting.figure`.
    """
    made = figure(
        height=height,
        sizing_mode="stretch_width",
        tools=options.pop("tools", _TOOLS),
        toolbar_location="right",
        output_backend="canvas",
        x_axis_label=x_label,
        y_axis_label=y_label,
        min_border_left=62,
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        **options,
    )
    made.toolbar.logo = None
    made.toolbar.autohide = True
    for axis in (*made.xaxis, *made.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
        axis.minor_tick_line_color = None
    return made


def source(name: str, *columns: str) -> ColumnDataSource:
    """An empty source that the page's script fills by its name."""
    return ColumnDataSource({column: [] for column in columns}, name=name)


def hover(
    made: figure, renderers: list[Any], *rows: tuple[str, str], mode: Literal["mouse", "vline"] = "mouse"
) -> None:
    """Values under the pointer, as text."""
    made.add_tools(HoverTool(renderers=renderers, tooltips=[*rows], mode=mode))


def log_axis(axis: Any, ticks: FixedTicker) -> None:
    """Plain numbers on a logarithmic axis, at places that the page's script chooses for what is in view."""
    axis.ticker = ticks
    axis.formatter = BasicTickFormatter(power_limit_high=5, power_limit_low=-3)


def place_legend(made: figure) -> None:
    """A legend above the figure, whose entries switch their curves on and off."""
    made.add_layout(made.legend[0], "above")
    made.legend.orientation = "horizontal"
    made.legend.click_policy = "hide"
    made.legend.label_text_font_size = "12px"
    made.legend.background_fill_alpha = 0.75
    made.legend.border_line_color = None
    made.legend.padding = 2  # type: ignore[assignment]
    made.legend.margin = 0
    made.legend.spacing = 18
