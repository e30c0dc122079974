"""One look for all figures: sizes, fonts, a colour-blind-safe palette, and a second cue beside colour."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import ArrayLike
from PIL import Image

from ema_pipeline.report.shown_band import shown_to

# Okabe & Ito (2008), "Color universal design": told apart with every common colour vision deficiency.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
GREY, LIGHT = "#6b6b6b", "#d9d9d9"

MEASURED, MODEL, SECOND = BLUE, VERMILLION, GREEN
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 2)))

WIDTH_IN = 7.2  # text width of an A4 page with 14 mm margins
_RC: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#444444",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.direction": "out",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7.0,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "#cccccc",
    "legend.fancybox": False,
    "lines.linewidth": 1.1,
    "lines.markersize": 4.0,
    "mathtext.fontset": "dejavusans",
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "path.simplify_threshold": 0.4,
    "agg.path.chunksize": 20000,
    "svg.fonttype": "none",
    "svg.hashsalt": "ema",
}

P = ParamSpec("P")


def styled(function: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw with this module's style, leaving matplotlib's global settings as they were."""

    @functools.wraps(function)
    def draw(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with matplotlib.rc_context(_RC):
            return function(*args, **kwargs)

    return draw


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure with an Agg canvas: never a window, never pyplot."""
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    return figure


def margins(
    figure: Figure, left: float = 0.62, right: float = 0.15, top: float = 0.32, bottom: float = 0.48
) -> dict[str, float]:
    """Margins in inches as the fractions that ``add_gridspec`` takes."""
    width, height = figure.get_size_inches()
    return {
        "left": left / width,
        "right": 1 - right / width,
        "top": 1 - top / height,
        "bottom": bottom / height,
    }


def png(figure: Figure) -> bytes:
    """The figure as PNG with 200 colours (a third of the size); the same bytes for the same figure."""
    with matplotlib.rc_context(_RC):
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    buffer = io.BytesIO()
    palette = image.quantize(200, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    colours = palette.getpalette() or []
    for k in range(0, len(colours), 3):
        if min(colours[k : k + 3]) >= 250:
            colours[k : k + 3] = 255, 255, 255  # the paper stays white
    palette.putpalette(colours)
    palette.save(buffer, format="png", dpi=(_RC["figure.dpi"],) * 2)
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """The figure as SVG without dates and with repeatable ids."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(_RC):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return _slim(buffer.getvalue())


def _slim(content: bytes) -> bytes:
    """Coordinates to 1/100 pt, no turns by zero, and fonts for readers who lack ours.

    Only inside tags: the numbers that people read are text between them.
    """
    return re.sub(rb"<[^<>]*>", lambda tag: _slim_tag(tag[0]), content)


def _slim_tag(tag: bytes) -> bytes:
    tag = re.sub(rb"(\d\.\d\d)\d+", rb"\1", tag)
    tag = re.sub(rb' transform="rotate\(-?0 [^"]*"', b"", tag)
    tag = tag.replace(b"font-family: 'DejaVu Sans'", b"font-family: 'DejaVu Sans', Verdana, sans-serif")
    return re.sub(rb"\s*\n\s*", b" ", tag)


def frequency_axis(ax: Axes, low_hz: float, high_hz: float, log: bool, label: bool = True) -> None:
    """Frequency axis in Hz, with plain numbers on a logarithmic axis too."""
    if log:
        ax.set_xscale("log")
        decades = np.log10(high_hz / low_hz)
        steps: Sequence[float] = (1, 2, 5) if decades < 3 else (1,)
        if decades < 0.5:
            steps = (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
        ticks = [s * 10.0**p for p in range(-3, 7) for s in steps]
        ax.xaxis.set_major_locator(FixedLocator([t for t in ticks if low_hz <= t <= high_hz]))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlim(low_hz, high_hz)
    if label:
        ax.set_xlabel("frequency, Hz")
    else:
        ax.tick_params(labelbottom=False)


def frequency_range(
    band_hz: tuple[float, float], modes_hz: ArrayLike, lines_hz: ArrayLike, others_hz: Iterable[float] = ()
) -> tuple[float, float, bool]:
    """Range to show, and whether it needs a logarithmic axis (modes over more than one decade).

    `others_hz` are to be seen beside the modes.
    """
    modes = np.asarray(modes_hz, dtype=float)
    lines = np.asarray(lines_hz, dtype=float)
    low, high = (float(b) if np.isfinite(b) else 0.0 for b in band_hz)
    if high <= low and lines.size:
        high = float(lines[-1])
    if modes.size:
        low, high = min(low, 0.9 * float(modes.min())), max(high, 1.03 * float(modes.max()))
        high = shown_to(high, [*modes.tolist(), *others_hz])
    low = max(low, 0.0)
    log = bool(modes.size and modes.max() > 8 * modes.min() > 0)
    if log:
        low = max(low, 0.4 * float(modes.min()), float(lines[lines > 0][0]) if (lines > 0).any() else 1e-3)
    return low, high, log


def log_y(ax: Axes) -> None:
    """Logarithmic y axis with few decade labels."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(base=10, numticks=6))
    ax.yaxis.set_minor_formatter(NullFormatter())


def mark_modes(ax: Axes, frequencies_hz: Sequence[float], numbers: bool = True, rows: int = 3) -> None:
    """Thin vertical lines at the modes with their numbers above the axes, staggered where they are close.

    Call it after the limits of the x axis are set.
    """
    figure = ax.get_figure()
    assert isinstance(figure, Figure)
    width_pt = ax.get_position().width * figure.get_size_inches()[0] * 72
    low, high = ax.get_xlim()
    log = ax.get_xscale() == "log"
    ends = [-np.inf] * rows
    for number, f in enumerate(frequencies_hz, start=1):
        if not low <= f <= high:
            continue
        ax.axvline(f, color="#9a9a9a", lw=0.6, ls=(0, (1, 1.5)), zorder=1)
        if not numbers:
            continue
        share = np.log(f / low) / np.log(high / low) if log else (f - low) / (high - low)
        at = float(share) * width_pt
        half = 2.6 * len(str(number)) + 1.0
        free = [r for r in range(rows) if at - half > ends[r]]
        if not free:
            continue
        row = free[0]
        ends[row] = at + half
        ax.annotate(
            str(number),
            (f, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2 + 7.5 * row),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=6.5,
            color=GREY,
            annotation_clip=False,
        )


def note(ax: Axes, text: str, x: float = 0.5, y: float = 0.5, **kwargs: object) -> None:
    """Plain words in the axes, for what cannot be drawn."""
    options: dict[str, object] = {"ha": "center", "va": "center", "color": GREY, "fontsize": 8}
    ax.text(x, y, text, transform=ax.transAxes, **(options | kwargs))  # type: ignore[arg-type]
