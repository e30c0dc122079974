"""What the commands of a series print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

from ema_pipeline.number_text import format_value, plain, prefixed_as
from ema_pipeline.observations.parts import DAMPING as MODAL_DAMPING
from ema_pipeline.series.compare import Comparison
from ema_pipeline.series.database import rows_of
from ema_pipeline.series.features import DAMPING
from ema_pipeline.series.judge import JudgedTest
from ema_pipeline.series.trend import Order, Trend

_MARK = {"pass": "✓", "fail": "✗", "undecided": "?"}
OUTLIERS_SHOWN = 15


def verdict_counts(tests: pd.DataFrame) -> str:
    """How many tests have which verdict, in one line."""
    told = tests["verdict"].fillna("no diagnosis").where(tests["state"] == "ok", "no results")
    return "Verdicts: " + ", ".join(
        f"{n} {str(word).replace('_', ' ')}" for word, n in told.value_counts().items()
    )


def _table(title: str, **columns: str) -> Table:
    made = Table(title=title, title_justify="left", box=box.SIMPLE)
    for name, justify in columns.items():
        made.add_column(name.replace("_", " "), justify=justify, overflow="fold")  # type: ignore[arg-type]
    return made


def judged_table(judged: Sequence[JudgedTest]) -> Table:
    """Every test with its outcome and the reason."""
    table = _table("Tests against their limits", test="left", outcome="left", why="left")
    for j in judged:
        table.add_row(j.test, f"{_MARK[j.outcome]} {j.outcome}", j.why)
    return table


def judged_counts(judged: Sequence[JudgedTest]) -> str:
    """How many pass, fail and are undecided."""
    counts = {word: sum(j.outcome == word for j in judged) for word in ("pass", "fail", "undecided")}
    return f"{counts['pass']} pass, {counts['fail']} fail, {counts['undecided']} undecided."


def comparison_table(found: Comparison) -> Table:
    """Every feature with its mean, its scatter and the uncertainty of one test."""
    table = _table(
        "Features of all tests (± 1 σ between tests)",
        feature="left", tests="right", mean="right", uncertainty_of_one="right", least="right", largest="right",
    )  # fmt: skip
    for name, row in found.table.iterrows():
        scale, unit = shown_in(str(name), str(row["unit"]))
        mean, std = scale * row["mean"], scale * row["std_between"]
        factor = scale * prefixed_as(mean, std, unit)[0]  # a row has one unit, that of its mean
        table.add_row(
            str(name),
            str(int(row["tests"])),
            format_value(mean, std, unit),
            *(
                plain(factor * row[column], figures)
                for column, figures in (("std_of_one", 2), ("min", 6), ("max", 6))
            ),
        )
    return table


def outlier_table(found: Comparison) -> Table:
    """Values that stand out, the farthest first."""
    table = _table(
        f"Values that stand out{'' if len(found.outliers) <= OUTLIERS_SHOWN else f', the farthest {OUTLIERS_SHOWN}'}",
        test="left", feature="left", value="right", median="right", distance="right",
    )  # fmt: skip
    for row in rows_of(found.outliers.head(OUTLIERS_SHOWN)):
        scale, unit = shown_in(row.feature, str(found.table.loc[row.feature, "unit"]))
        value = format_value(scale * row.value, scale * row.std, unit)
        table.add_row(
            str(row.test),
            row.feature,
            value,
            format_value(scale * row.typical, float("nan"), unit),
            f"{row.z:+.1f} σ",
        )
    return table


def trend_table(trends: Sequence[Trend], order: Order) -> Table:
    """Every feature along the series."""
    table = _table(
        f"Along the series, by {order.by}", feature="left", finding="left", slope="right", p="right",
        step_p="right", outside_the_control_limits="left",
    )  # fmt: skip
    for t in trends:
        outside = ", ".join(t.outside) or "none"
        table.add_row(t.feature, finding(t), slope_text(t, order), f"{t.p:.2g}", f"{t.step_p:.2g}", outside)
    return table


def shown_in(feature: str, unit: str) -> tuple[float, str]:
    """Factor and unit in which a feature is shown: damping in per cent."""
    return (100.0, "%") if feature.endswith(DAMPING) or feature == MODAL_DAMPING else (1.0, unit)


def slope_text(t: Trend, order: Order) -> str:
    """Slope with its standard deviation and unit."""
    scale, unit = shown_in(t.feature, t.unit)
    return f"{format_value(scale * t.slope, scale * t.slope_std)} {'' if unit == '1' else unit}/{order.unit}"


def finding(t: Trend) -> str:
    """What a feature does along the series, in words."""
    if t.drifts:
        return "drifts up" if t.slope > 0 else "drifts down"
    return f"steps at {', '.join(t.steps)}" if t.steps else "steady"


def trend_json(trends: Sequence[Trend], order: Order) -> dict[str, Any]:
    """The same for other programs."""
    return {
        "by": order.by,
        "unit": order.unit,
        "tests": list(order.tests),
        "features": [vars(t) for t in trends],
    }
