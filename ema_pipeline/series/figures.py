"""Figures of a series: every feature along the tests and its distribution, with limits and outliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ema_pipeline.number_text import prefixed
from ema_pipeline.report.style import BLACK, BLUE, GREY, VERMILLION, margins, new_figure, styled
from ema_pipeline.series.acceptance_limits import Range
from ema_pipeline.series.features import DAMPING, FREQUENCY, PARAMETER, Features
from ema_pipeline.series.screens import shown_in

MOST_FEATURES = 24
"""Features of one kind that are drawn, those with the largest scatter for their uncertainty."""
_ROW_IN = 1.75
_TITLES = {FREQUENCY: "Frequencies", DAMPING: "Damping ratios", PARAMETER: "Parameters"}
_MOST_BARS = 150
"""Tests above which error bars would hide the points."""


def feature_figures(
    features: Features,
    order: Sequence[str],
    by: str,
    limits: Mapping[str, Range],
    outlying: Mapping[str, Sequence[str]],
) -> list[tuple[str, Figure]]:
    """One figure for each kind of feature, with its caption.

    Parameters
    ----------
    features : Features
    order : sequence of str
        Tests from left to right.
    by : str
        What they are ordered by.
    limits : dict of str to Range
        By feature.
    outlying : dict of str to sequence of str
        Tests that stand out, by feature.
    """
    found = []
    for quantity, title in _TITLES.items():
        names = _chosen(features, quantity)
        if names:
            caption = (
                f"{title}: every test, by {by} (bars: 95 % interval of each), and the distribution over all tests. "
                "Dashed lines: limits; open squares: values that stand out."
            )
            found.append((caption, _drawn(features, names, order, by, limits, outlying)))
    return found


def _chosen(features: Features, quantity: str) -> list[str]:
    names = features.about.index[features.about["quantity"] == quantity]
    spread = features.values[names].std() / features.stds[names].median().replace(0.0, np.nan)
    chosen = set(spread.fillna(0.0).sort_values(ascending=False).index[:MOST_FEATURES])
    return [str(n) for n in names if n in chosen]


@styled
def _drawn(
    features: Features,
    names: Sequence[str],
    order: Sequence[str],
    by: str,
    limits: Mapping[str, Range],
    outlying: Mapping[str, Sequence[str]],
) -> Figure:
    columns = 2 if len(names) > 1 else 1
    rows = -(-len(names) // columns)
    figure = new_figure(0.35 + _ROW_IN * rows)
    cells = figure.add_gridspec(rows, columns, wspace=0.3, hspace=0.75, **margins(figure, left=0.72, top=0.3))
    for k, name in enumerate(names):
        grid = cells[divmod(k, columns)].subgridspec(1, 2, width_ratios=[4, 1], wspace=0.18)
        ax = figure.add_subplot(grid[0])
        side = figure.add_subplot(grid[1], sharey=ax)
        values, stds = features.values[name].reindex(list(order)), features.stds[name].reindex(list(order))
        scale, unit = shown_in(name, str(features.about.loc[name, "unit"]))
        if scale == 1.0:
            scale, unit = prefixed(float(values.abs().median()), unit)
        _along(ax, scale * values, scale * stds, outlying.get(name, ()))
        _beside(side, scale * values)
        if name in limits:
            for limit in (limits[name].min, limits[name].max):
                if limit is not None:
                    ax.axhline(scale * limit, color=VERMILLION, lw=0.9, ls=(0, (4, 2)))
                    side.axhline(scale * limit, color=VERMILLION, lw=0.9, ls=(0, (4, 2)))
        ax.set_title(name, loc="left")
        ax.set_ylabel(unit if unit != "1" else "")
        ax.ticklabel_format(axis="y", useOffset=False, scilimits=(-3, 5))
        ax.locator_params(axis="y", nbins=4)
        if k + columns >= len(names):
            ax.set_xlabel(f"test, by {by}")
            side.set_xlabel("count")
    return figure


def _along(ax: Axes, values: pd.Series[float], stds: pd.Series[float], outlying: Sequence[str]) -> None:
    at = np.arange(1, len(values) + 1)
    bars = 1.96 * stds.to_numpy() if len(values) <= _MOST_BARS else None
    if bars is not None:
        bars = np.nan_to_num(bars)
    ax.errorbar(at, values.to_numpy(), yerr=bars, fmt="o", ms=2.6, lw=0.7, color=BLUE, ecolor=GREY)
    far = [i for i, t in enumerate(values.index) if t in set(outlying)]
    ax.plot(at[far], values.to_numpy()[far], "s", ms=7, mfc="none", mec=BLACK, mew=1.0)
    ax.set_xlim(0, len(values) + 1)
    ax.locator_params(axis="x", integer=True)


def _beside(ax: Axes, values: pd.Series[float]) -> None:
    known = values.dropna().to_numpy()
    if len(known) and np.ptp(known) > 0:
        bins = int(np.clip(np.sqrt(len(known)), 4, 30))
        ax.hist(known, bins=bins, orientation="horizontal", color=BLUE, alpha=0.55, edgecolor="white", lw=0.4)
    ax.tick_params(labelleft=False)
    ax.locator_params(axis="x", nbins=2, integer=True)
