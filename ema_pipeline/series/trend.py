"""What moves along a series: drift, steps, and points outside a control chart."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy.stats
from numpy.typing import NDArray

from ema_pipeline.series.features import MAC, Features
from ema_pipeline.significance import holm

LEVEL = 0.01
"""Chance of a false drift or step in all features of a series together."""
_LEAST = 6
"""Tests below which nothing is said of a trend."""
_SEGMENT = 3
"""Fewest tests between two steps."""
_CHART_FACTOR = 2.66
"""3 over d2 = 1.128: limits of a chart of individuals from the mean moving range, ISO 7870-2:2013, table 2."""


@dataclass(frozen=True)
class Order:
    """The order of the tests.

    Attributes
    ----------
    tests : tuple of str
    at : ndarray, (n,)
        Where each stands, in `unit`.
    unit : str
        ``"day"`` where every test has a date, else ``"test"``.
    by : str
        ``"date"``, ``"serial number"`` or ``"name"``.
    """

    tests: tuple[str, ...]
    at: NDArray[np.float64]
    unit: str
    by: str


@dataclass(frozen=True)
class Trend:
    """One feature along the series.

    Attributes
    ----------
    feature, unit : str
    slope, slope_std : float
        Per unit of the order, by least squares; the scatter about the line is its uncertainty.
    p : float
        Of no drift, adjusted for the number of features (Holm).
    drifts : bool
    steps : tuple of str
        First test after each step.
    step_p : float
        Of no step, adjusted alike; of the largest one.
    centre, low, high : float
        Control chart of individual values: mean and limits.
    outside : tuple of str
        Tests beyond these limits.
    """

    feature: str
    unit: str
    slope: float
    slope_std: float
    p: float
    drifts: bool
    steps: tuple[str, ...]
    step_p: float
    centre: float
    low: float
    high: float
    outside: tuple[str, ...]


def order_of(tests: pd.DataFrame, by: str | None = None) -> Order:
    """The order of the tests with results: by date where all have one, else by serial number, else by name.

    Parameters
    ----------
    tests : DataFrame
        Table ``tests``.
    by : str, optional
        ``"date"``, ``"serial"`` or ``"name"``.
    """
    ok = tests[tests["state"] == "ok"]
    dates = ok["date"].fillna("").astype(str)
    serials = ok["serial_number"].fillna("").astype(str)
    by = by or (
        "date"
        if len(ok) and (dates != "").all()
        else "serial"
        if len(ok) and (serials != "").all()
        else "name"
    )
    if by == "date":
        days = pd.to_datetime(dates.where(dates != "", None), format="ISO8601", utc=True)
        known = days.dropna().sort_values(kind="stable")
        at = (known - known.iloc[0]).dt.total_seconds().to_numpy() / 86400.0 if len(known) else np.zeros(0)
        return Order(tuple(ok.loc[known.index, "test"]), np.asarray(at, float), "day", "date")
    words = serials if by == "serial" else ok["test"].astype(str)
    ordered = ok.loc[words.map(_natural).sort_values(kind="stable").index, "test"]
    return Order(
        tuple(ordered),
        np.arange(len(ordered), dtype=float),
        "test",
        "serial number" if by == "serial" else "name",
    )


def _natural(text: str) -> tuple[tuple[int, float, str], ...]:
    """A key by which ``unit10`` stands after ``unit9``."""
    return tuple((0, float(p), "") if p.isdigit() else (1, 0.0, p) for p in re.split(r"(\d+)", text) if p)


def trends_of(features: Features, order: Order, level: float = LEVEL) -> list[Trend]:
    """Drift, steps and control chart of every feature that enough tests have."""
    at = pd.Series(order.at, index=list(order.tests))
    names = [n for n in features.values.columns if features.about.loc[n, "quantity"] != MAC]
    data = {n: features.values[n].reindex(list(order.tests)).dropna() for n in names}
    data = {n: d for n, d in data.items() if len(d) >= _LEAST}
    fits = {
        n: scipy.stats.linregress(at[d.index].to_numpy(), d.to_numpy())
        for n, d in data.items()
        if np.ptp(at[d.index]) > 0
    }
    slopes = dict(zip(fits, holm([f.pvalue for f in fits.values()]), strict=True))
    raw = {n: _step(d.to_numpy()) for n, d in data.items()}
    steps = dict(zip(raw, holm([p for _, p in raw.values()]), strict=True))
    found = []
    for n, d in data.items():
        if n not in fits:
            continue
        values = np.asarray(d, float)
        stepped = _all_steps(values, level / len(data)) if steps[n] < level else []
        centre, half = float(np.mean(values)), _CHART_FACTOR * float(np.mean(np.abs(np.diff(values))))
        outside = tuple(str(t) for t in d.index[np.abs(values - centre) > half])
        drifts = bool(slopes[n] < level)
        if drifts and stepped and not _better_as_steps(np.asarray(at[d.index], float), values, stepped):
            stepped = []
        elif stepped:
            drifts = False
        found.append(
            Trend(
                feature=str(n),
                unit=str(features.about.loc[n, "unit"]),
                slope=float(fits[n].slope),
                slope_std=float(fits[n].stderr),
                p=float(slopes[n]),
                drifts=drifts,
                steps=tuple(str(d.index[k]) for k in stepped),
                step_p=float(steps[n]),
                centre=centre,
                low=centre - half,
                high=centre + half,
                outside=outside,
            )
        )
    return found


def _better_as_steps(at: NDArray[np.float64], values: NDArray[np.float64], steps: list[int]) -> bool:
    """True where steps explain the values better than a line, each by its number of free values (BIC)."""
    line = scipy.stats.linregress(at, values)
    left = values - line.intercept - line.slope * at
    means = np.concatenate([np.full(len(part), np.mean(part)) for part in np.split(values, steps)])
    n = len(values)

    def score(residual: NDArray[np.float64], free: int) -> float:
        return n * float(np.log(max(float(np.mean(residual**2)), 1e-300))) + free * np.log(n)

    return score(values - means, 1 + 2 * len(steps)) < score(left, 2)


def _all_steps(values: NDArray[np.float64], level: float, start: int = 0) -> list[int]:
    """Positions after which the mean is another one, by binary segmentation; the first one is there."""
    at, _ = _step(values)
    found = [start + at]
    for part, offset in ((values[:at], start), (values[at:], start + at)):
        if _step(part)[1] < level:
            found += _all_steps(part, level, offset)
    return sorted(found)


def _step(values: NDArray[np.float64]) -> tuple[int, float]:
    """Most probable position of one step of the mean, and its p-value.

    Student's t-test of the means before and after at every position, the smallest p-value times the number of positions
    (Bonferroni): never too small.
    """
    n = len(values)
    if n < 2 * _SEGMENT or np.ptp(values) == 0:
        return 0, 1.0
    k = np.arange(_SEGMENT, n - _SEGMENT + 1)
    before, total = np.cumsum(values)[k - 1], float(np.sum(values))
    step = before / k - (total - before) / (n - k)
    within = np.sum((values - total / n) ** 2) - step**2 * k * (n - k) / n
    t = np.abs(step) * np.sqrt(k * (n - k) / n * (n - 2) / np.maximum(within, 1e-300))
    best = int(np.argmax(t))
    return int(k[best]), float(min(1.0, len(k) * 2 * scipy.stats.t.sf(t[best], n - 2)))
