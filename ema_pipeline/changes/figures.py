"""FRFs of two tests over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ema_pipeline.frf.types import FrfSet
from ema_pipeline.report.figures.frf import accelerance_unit
from ema_pipeline.report.style import BLUE, VERMILLION, log_y, margins, new_figure, styled

MOST_FRFS = 6
"""FRFs of one configuration that are drawn: driving points first."""
_MOST_POINTS = 2500

Pick = tuple[str, tuple[int, int], tuple[int, int]]
"""Title, and the output and input of an FRF in A and in B."""


def common_frfs(a: FrfSet, b: FrfSet) -> list[Pick]:
    """FRFs that both tests measured, driving points first, at most `MOST_FRFS`."""
    out_b = {d.point: i for i, d in enumerate(b.outputs)}
    in_b = {d.point: i for i, d in enumerate(b.inputs)}
    found: list[tuple[bool, Pick]] = []
    for j, struck in enumerate(a.inputs):
        for i, seen in enumerate(a.outputs):
            if struck.point not in in_b or seen.point not in out_b:
                continue
            at = (out_b[seen.point], in_b[struck.point])
            if a.hits[i, j] and b.hits[at]:
                found.append((seen.point != struck.point, (f"{seen.point} / {struck.point}", (i, j), at)))
    return [pick for _, pick in sorted(found, key=lambda f: f[0])[:MOST_FRFS]]


@styled
def overlay(a: FrfSet, b: FrfSet, picks: Sequence[Pick], high_hz: float) -> Figure:
    """Magnitude of the accelerance of both tests, one panel per FRF.

    Parameters
    ----------
    a, b : FrfSet
    picks : sequence of Pick
    high_hz : float
        End of the frequency axis.
    """
    columns = 2 if len(picks) > 1 else 1
    rows = -(-len(picks) // columns)
    figure = new_figure(0.55 + 1.95 * rows)
    cells = figure.add_gridspec(rows, columns, wspace=0.28, hspace=0.55, **margins(figure, top=0.5))
    for k, (title, at_a, at_b) in enumerate(picks):
        ax = figure.add_subplot(cells[divmod(k, columns)])
        for frfs, at, colour, line, name in ((a, at_a, BLUE, "-", "A"), (b, at_b, VERMILLION, "--", "B")):
            frequency, magnitude = _magnitude(frfs, at, high_hz)
            ax.plot(frequency, magnitude, color=colour, ls=line, lw=0.9, label=name)
        log_y(ax)
        ax.set_xlim(0, high_hz)
        ax.set_title(title, loc="left")
        ax.set_ylabel(f"|H|, {accelerance_unit(a)}")
        if k + columns >= len(picks):
            ax.set_xlabel("frequency, Hz")
        if k == 0:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.02), ncols=2, borderaxespad=0.0)
    return figure


def _magnitude(
    frfs: FrfSet, at: tuple[int, int], high_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Magnitude up to a frequency; of more points than a screen has, the largest of each few, so that peaks stay."""
    on = (frfs.frequency_hz > 0) & (frfs.frequency_hz <= high_hz)
    frequency, magnitude = frfs.frequency_hz[on], np.abs(frfs.accelerance()[at][on])
    step = -(-len(frequency) // _MOST_POINTS)
    if step > 1:
        count = len(frequency) // step * step
        frequency = frequency[:count].reshape(-1, step)[:, step // 2]
        magnitude = magnitude[:count].reshape(-1, step).max(axis=1)
    return frequency, magnitude


def overlays(
    a: Mapping[str, FrfSet], b: Mapping[str, FrfSet], high_hz: Mapping[str, float]
) -> dict[str, Figure]:
    """The figure of every configuration with FRFs in common."""
    found = {}
    for name in (n for n in a if n in b):
        picks = common_frfs(a[name], b[name])
        if picks:
            found[name] = overlay(a[name], b[name], picks, high_hz[name])
    return found
