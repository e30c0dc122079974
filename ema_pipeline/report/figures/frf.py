"""FRF sheets: magnitude, phase and coherence of chosen FRFs, and an overlay of all with the CMIF."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ema_pipeline.frf.overview import cmif
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.modal.types import ModalModel
from ema_pipeline.number_text import counted
from ema_pipeline.report.shown_band import places
from ema_pipeline.report.style import (
    LINES,
    MEASURED,
    MODEL,
    SERIES,
    frequency_axis,
    frequency_range,
    log_y,
    margins,
    mark_modes,
    new_figure,
    note,
    styled,
)

FRFS_PER_SHEET = 2
_OVERLAY_LINES = 240


def accelerance_unit(frfs: FrfSet) -> str:
    """Unit of the accelerance; an uncalibrated hammer leaves it per volt."""
    return "(m/s²)/N" if frfs.force_calibrated else "(m/s²)/V"


@styled
def frf_sheet(frfs: FrfSet, modal: ModalModel | None, picks: Sequence[tuple[int, int]]) -> Figure:
    """Magnitude, phase and coherence of up to two FRFs, with the modal model's synthesis over them.

    Of several forces at once both coherences are drawn: the partial one of the FRF's force, and the multiple one.

    Parameters
    ----------
    frfs : FrfSet
    modal : ModalModel or None
    picks : sequence of (output, input) indices
    """
    columns = len(picks)
    figure = new_figure(4.5)
    grid = figure.add_gridspec(
        3,
        max(columns, FRFS_PER_SHEET),
        height_ratios=(2.2, 1, 1),
        hspace=0.12,
        wspace=0.24,
        **margins(figure, top=0.62),
    )
    modes = [m.frequency_hz for m in modal.modes] if modal else []
    band = modal.band_hz if modal else frfs.band_hz
    low, high, log = frequency_range(band, modes, frfs.frequency_hz, places(modal))
    f = frfs.frequency_hz
    shown = (f >= low) & (f <= high) & (f > 0)
    accelerance = frfs.accelerance()
    for column, (o, i) in enumerate(picks):
        top, middle, bottom = (figure.add_subplot(grid[r, column]) for r in range(3))
        h = accelerance[o, i]
        hits = int(frfs.hits[o, i])
        average = f"mean of {counted(hits, frfs.averaged)}" if hits > 1 else f"one {frfs.averaged}"
        label = f"measured, {average}"
        _curve(top, f[shown], np.abs(h[shown]), MEASURED, "-", label)
        _curve(middle, f[shown], phase_deg(h[shown]), MEASURED, "-")
        if modal is not None:
            model = _synthesis_of(modal, frfs, o, i)
            if model is not None:
                keep = (modal.frequency_hz >= low) & (modal.frequency_hz <= high)
                g = modal.frequency_hz[keep]
                _curve(top, g, np.abs(model[keep]), MODEL, "--", "modal model")
                _curve(middle, g, phase_deg(model[keep]), MODEL, "--")
        log_y(top)
        _limit_decades(top, np.abs(h[shown]))
        top.legend(loc="lower right", ncols=1, handlelength=2.4, borderpad=0.3)
        title = f"{frfs.outputs[o].point} ← {frfs.inputs[i].point}"
        driving = frfs.outputs[o].point == frfs.inputs[i].point
        top.set_title(title + (" (driving point)" if driving else ""), pad=27)
        middle.set_ylim(-190, 190)
        middle.set_yticks([-180, -90, 0, 90, 180])
        bottom.set_ylim(-0.04, 1.06)
        if np.isfinite(frfs.coherence[o, i, shown]).any():
            _curve(bottom, f[shown], frfs.coherence[o, i, shown], "#333333", "-", "partial")
            if frfs.multiple_coherence is not None:
                _curve(bottom, f[shown], frfs.multiple_coherence[o, shown], MODEL, "--", "multiple")
                bottom.legend(loc="lower left", ncols=2, handlelength=2.4, borderpad=0.3)
        else:
            note(bottom, "one hit: no coherence" if hits <= 1 else "no coherence")
        frequency_axis(top, low, high, log, label=False)
        frequency_axis(middle, low, high, log, label=False)
        frequency_axis(bottom, low, high, log)
        mark_modes(top, modes)
        mark_modes(middle, modes, numbers=False)
        mark_modes(bottom, modes, numbers=False)
        if column == 0:
            top.set_ylabel(f"|accelerance|, {accelerance_unit(frfs)}")
            middle.set_ylabel("phase, °")
            bottom.set_ylabel("coherence, 1")
            figure.align_ylabels([top, middle, bottom])
    return figure


@styled
def frf_overview(frfs: FrfSet, modal: ModalModel | None) -> Figure:
    """All FRFs over one another, and below them the CMIF: singular values of the FRF matrix.

    Peaks of the second singular value show modes that are close or multiple (Shih et al. 1988).
    """
    figure = new_figure(4.3)
    grid = figure.add_gridspec(2, 1, hspace=0.14, height_ratios=(1, 1.1), **margins(figure, top=0.62))
    top, bottom = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    modes = [m.frequency_hz for m in modal.modes] if modal else []
    band = modal.band_hz if modal else frfs.band_hz
    low, high, log = frequency_range(band, modes, frfs.frequency_hz, places(modal))
    f = frfs.frequency_hz
    shown = (f >= low) & (f <= high) & (f > 0)
    h = frfs.accelerance()[..., shown]
    rows = np.abs(h[frfs.hits > 0])
    step = max(1, int(np.ceil(len(rows) / _OVERLAY_LINES)))
    curves = LineCollection(
        [np.column_stack([f[shown], row]) for row in rows[::step]],
        colors=MEASURED,
        linewidths=0.4,
        alpha=max(0.12, min(0.6, 12 / max(len(rows), 1))),
        rasterized=True,
    )
    top.add_collection(curves)
    mean = np.sqrt(np.nanmean(rows**2, axis=0))
    _curve(top, f[shown], mean, "#000000", "-")
    some = f", every {step}th drawn" if step > 1 else ""
    top.legend(
        [Line2D([], [], color=MEASURED, lw=0.7), Line2D([], [], color="#000000")],
        [f"{len(rows)} FRFs{some}", "root mean square"],
        loc="lower right",
        borderpad=0.3,
    )
    log_y(top)
    _limit_decades(top, rows)
    top.set_title("All FRFs and their mode indicator", pad=27)
    top.set_ylabel(f"|accelerance|, {accelerance_unit(frfs)}")
    values = cmif(h)
    for k, row in enumerate(values):
        _curve(bottom, f[shown], row, SERIES[k], LINES[k], f"singular value {k + 1}")
    log_y(bottom)
    _limit_decades(bottom, values[:2])
    bottom.set_ylabel(f"CMIF, {accelerance_unit(frfs)}")
    bottom.legend(loc="lower right", ncols=2, borderpad=0.3, handlelength=2.6)
    frequency_axis(top, low, high, log, label=False)
    frequency_axis(bottom, low, high, log)
    mark_modes(top, modes)
    mark_modes(bottom, modes, numbers=False)
    figure.align_ylabels([top, bottom])
    return figure


def phase_deg(frf: NDArray[np.complex128] | NDArray[np.complex64]) -> NDArray[np.float64]:
    """Phase in degrees, NaN after each wrap so that no vertical line is drawn there."""
    phase = np.rad2deg(np.angle(frf))
    wraps = np.flatnonzero(np.abs(np.diff(phase)) > 180) + 1
    phase[wraps] = np.nan
    return np.asarray(phase)


def _synthesis_of(modal: ModalModel, frfs: FrfSet, o: int, i: int) -> NDArray[np.complex64] | None:
    outputs = [d.point for d in modal.outputs]
    inputs = [d.point for d in modal.inputs]
    out, inp = frfs.outputs[o].point, frfs.inputs[i].point
    if out not in outputs or inp not in inputs:
        return None
    row = modal.synthesis[outputs.index(out), inputs.index(inp)]
    return row if np.isfinite(row).any() else None


def _curve(
    ax: Axes, x: NDArray[np.float64], y: NDArray[np.float64], color: str, line: object, label: str = ""
) -> None:
    # dense curves become pixels inside the SVG, which would be megabytes otherwise
    width = 0.8 if len(x) > 1500 else 1.1
    ax.plot(x, y, color=color, ls=line, lw=width, label=label or "_", rasterized=len(x) > 1500)


def _limit_decades(ax: Axes, values: NDArray[np.float64], decades: float = 6.0) -> None:
    """Limits from the data, without letting a single deep notch squeeze everything else."""
    finite = values[np.isfinite(values) & (values > 0)]
    if finite.size:
        high = float(finite.max())
        low = max(float(np.percentile(finite, 0.2)) / 1.5, high * 10.0**-decades)
        ax.set_ylim(low, high * 2.0)
