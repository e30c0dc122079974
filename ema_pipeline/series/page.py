"""The report of a series: one self-contained page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from ema_pipeline.diagnose.sentences import label_text, probability_text
from ema_pipeline.files import replace_file
from ema_pipeline.number_text import counted, format_value, plain
from ema_pipeline.report.pages import page_templates
from ema_pipeline.report.style import png
from ema_pipeline.report.tables import Row, Table
from ema_pipeline.series.acceptance_limits import Limits, reference_modes
from ema_pipeline.series.compare import Comparison, compare_tests
from ema_pipeline.series.database import SeriesDatabase, rows_of
from ema_pipeline.series.features import features_of, modes_of_tests, reference_of
from ema_pipeline.series.figures import feature_figures
from ema_pipeline.series.judge import JudgedTest, effects_text, judge_series
from ema_pipeline.series.screens import finding, judged_counts, shown_in, slope_text, verdict_counts
from ema_pipeline.series.trend import Order, Trend, order_of, trends_of

REPORT = "report.html"
_OUTLIERS = 100
"""Values listed among those that stand out."""


@dataclass(frozen=True)
class Cell:
    """One cell of the table of tests; `sort` is the number that it is sorted by, `link` where it leads."""

    text: str
    sort: float | None = None
    link: str = ""


def write_page(database: SeriesDatabase, limits: Limits | None = None, reference: str | None = None) -> Path:
    """Write the page into the folder of the series.

    Parameters
    ----------
    database : SeriesDatabase
    limits : Limits, optional
        Every test is judged by them; not judged where left out.
    reference : str, optional
        Test that numbers the modes, where there are no limits.
    """
    path = database.folder / REPORT
    text = page_templates().get_template("series.html.j2").render(_content(database, limits, reference))
    replace_file(path, text)
    return path


def _content(database: SeriesDatabase, limits: Limits | None, reference: str | None) -> dict[str, Any]:
    tests, effects, modes = database.table("tests"), database.table("effects"), modes_of_tests(database)
    judged = {} if limits is None else {j.test: j for j in judge_series(database, limits)}
    if limits is not None and limits.modes:
        numbered, numbers = reference_modes(limits), "the limits"
    elif modes:
        named = reference_of(database, modes, reference)
        numbered, numbers = modes[named], f"test {named}"
    else:
        numbered, numbers = {}, "no test"
    features = features_of(modes, numbered, database.table("parameters"))
    order = order_of(tests)
    compared, trends = compare_tests(features), trends_of(features, order)
    ranges = {v.name: v.limits for j in judged.values() for v in j.values}
    outlying = {str(k): list(t) for k, t in compared.outliers.groupby("feature")["test"]}
    figures = feature_figures(features, order.tests, order.by, ranges, outlying)
    return {
        "title": f"Series of {counted(len(tests), 'test')}",
        "subtitle": f"{database.about('tree')}; modes have the numbers of {numbers}.",
        "summary": _summary(tests, effects, list(judged.values()), compared, trends),
        **_test_table(database.folder, tests, effects, judged),
        "outliers": [t for t in (_effect_table(effects), _outlier_table(compared)) if t],
        "figures": [
            {"data": base64.b64encode(png(figure)).decode(), "caption": caption}
            for caption, figure in figures
        ],
        "trends": _trend_table(trends, order),
    }


def _summary(
    tests: pd.DataFrame,
    effects: pd.DataFrame,
    judged: Sequence[JudgedTest],
    compared: Comparison,
    trends: Sequence[Trend],
) -> list[str]:
    lines = [judged_counts(judged)] if judged else []
    lines.append(verdict_counts(tests) + ".")
    if len(effects):
        found = effects.drop_duplicates(["test", "effect", "at"])
        counts = (found["effect"] + "@" + found["at"]).value_counts()
        lines.append(
            "Effects found: " + ", ".join(f"{label_text(str(k))} in {n}" for k, n in counts.items()) + "."
        )
    if len(compared.outliers):
        lines.append(
            f"Tests with values that stand out from the others: {compared.outliers['test'].nunique()}."
        )
    moving = [f"{t.feature} {finding(t)}" for t in trends if finding(t) != "steady"]
    if moving:
        lines.append("Along the series: " + "; ".join(moving[:5]) + (" …" if len(moving) > 5 else "") + ".")
    return lines


def _test_table(
    folder: Path, tests: pd.DataFrame, effects: pd.DataFrame, judged: Mapping[str, JudgedTest]
) -> dict[str, Any]:
    head = [
        "test",
        "serial number",
        "date",
        *(["outcome"] if judged else []),
        "verdict",
        "error, σ",
        "hits used",
        "hits rejected",
        "modes",
        "why",
    ]
    own = {str(name): rows for name, rows in effects.groupby("test")}
    rows = []
    for row in rows_of(tests):
        name = str(row.test)
        j = judged.get(name)
        told = effects_text(own[name]) if name in own else ""
        why = j.why if j is not None else told or _text(row.reason)
        cells = [
            Cell(name, link=_link(folder, row.results)),
            Cell(_text(row.serial_number)),
            Cell(_text(row.date)),
            *([Cell(j.outcome)] if j is not None else []),
            Cell(_text(row.verdict).replace("_", " ") if row.state == "ok" else "no results"),
            *(_number(v) for v in (row.error, row.hits_used, row.hits_rejected, row.modes)),
            Cell(why),
        ]
        alert = row.state != "ok" or (j.outcome == "fail" if j is not None else bool(told))
        rows.append({"cells": cells, "alert": alert})
    first = head.index("error, σ")
    return {"head": head, "rows": rows, "numeric": range(first, first + 4)}


def _number(value: float | None) -> Cell:
    if value is None or not np.isfinite(value):
        return Cell("–", float("nan"))
    return Cell(str(int(value)) if float(value).is_integer() else plain(float(value), 3), float(value))


def _text(value: object) -> str:
    """A text of the database; empty where there is none."""
    return value if isinstance(value, str) else ""


def _link(folder: Path, results: object) -> str:
    """Where the report of one test is, as seen from the page."""
    path = Path(str(results)) / REPORT
    if not isinstance(results, str) or not path.is_file():
        return ""
    if path.is_relative_to(folder.resolve()):
        return quote(path.relative_to(folder.resolve()).as_posix())
    return path.as_uri()


def _effect_table(effects: pd.DataFrame) -> dict[str, Any] | None:
    """Outliers by what is physically the matter: one row per effect and test."""
    if not len(effects):
        return None
    rows = [
        Row(
            (
                label_text(f"{e.effect}@{e.at}"),
                str(e.test),
                f"{e.name} {format_value(e.value, e.std, e.unit)}",
                probability_text(e.probability),
            )
        )
        for e in rows_of(effects.sort_values(["effect", "at", "test"]))
    ]
    return {
        "table": Table(("effect", "test", "size (±1σ)", "probability"), tuple(rows), frozenset({3})),
        "caption": "By physical effect: what the diagnosis of each test claims",
    }


def _outlier_table(compared: Comparison) -> dict[str, Any] | None:
    if not len(compared.outliers):
        return None
    head = ("test", "feature", "value (±1σ)", "median of all", "distance, σ")
    rows = []
    for o in rows_of(compared.outliers.head(_OUTLIERS)):
        scale, unit = shown_in(o.feature, str(compared.table.loc[o.feature, "unit"]))
        value = format_value(scale * o.value, scale * o.std, unit)
        rows.append(
            Row(
                (o.test, o.feature, value, format_value(scale * o.typical, float("nan"), unit), f"{o.z:+.1f}")
            )
        )
    return {
        "table": Table(head, tuple(rows), frozenset({2, 3, 4})),
        "caption": "By value: modified z-score above 3.5, the farthest first",
    }


def _trend_table(trends: Sequence[Trend], order: Order) -> dict[str, Any] | None:
    if not trends:
        return None
    head = (
        "feature",
        "finding",
        "slope (±1σ)",
        "p of no drift",
        "p of no step",
        "outside the control limits",
    )
    caption = (
        f"By {order.by}; p over all features together (Holm); control limits: mean ± 2.66 mean moving ranges "
        "(ISO 7870-2)"
    )
    rows = tuple(_trend_row(t, order) for t in trends)
    return {"table": Table(head, rows, frozenset({2, 3, 4})), "caption": caption}


def _trend_row(t: Trend, order: Order) -> Row:
    cells = (
        t.feature,
        finding(t),
        slope_text(t, order),
        f"{t.p:.2g}",
        f"{t.step_p:.2g}",
        ", ".join(t.outside[:8]) or "none",
    )
    return Row(cells, alert=finding(t) != "steady")
