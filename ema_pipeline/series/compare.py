"""How the tests of a series differ: scatter of every feature beside its uncertainty, and the tests that stand out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from ema_pipeline.series.features import MAC, Features

OUTLYING = 3.5
"""Modified z-score from which a value is an outlier: B. Iglewicz, D. C. Hoaglin, How to Detect and Handle Outliers,
ASQC, 1993."""
_TO_SIGMA = 1.4826
"""Median absolute deviation of a normal variable to its 1 σ."""
_LEAST = 4
_COLUMNS = ["feature", "unit", "tests", "mean", "std_between", "std_of_one", "min", "max"]


@dataclass(frozen=True)
class Comparison:
    """The features of a series beside each other.

    Attributes
    ----------
    table : DataFrame
        By feature: unit, tests, mean, std between tests, median own std of one test, min, max.
    outliers : DataFrame
        Columns test, feature, value, std, typical, z; the farthest first.
    """

    table: pd.DataFrame
    outliers: pd.DataFrame


def compare_tests(features: Features) -> Comparison:
    """Mean and scatter of every feature, and the values that stand out from the others.

    What stands out is told by the modified z-score, in which the value's own uncertainty counts as well.
    """
    rows, outliers = [], []
    for name in features.values.columns:
        values, stds = features.values[name], features.stds[name]
        known = values.dropna()
        rows.append(
            {
                "feature": name,
                "unit": features.about.loc[name, "unit"],
                "tests": len(known),
                "mean": known.mean(),
                "std_between": known.std(ddof=1) if len(known) > 1 else np.nan,
                "std_of_one": stds[known.index].median(),
                "min": known.min(),
                "max": known.max(),
            }
        )
        if len(known) >= _LEAST and features.about.loc[name, "quantity"] != MAC:
            outliers += _outlying(str(name), known, stds[known.index].fillna(0.0))
    columns = ["test", "feature", "value", "std", "typical", "z"]
    found = pd.DataFrame(outliers, columns=columns).sort_values(
        "z", key=np.abs, ascending=False, ignore_index=True
    )
    return Comparison(pd.DataFrame(rows, columns=_COLUMNS).set_index("feature"), found)


def _outlying(name: str, values: pd.Series[float], stds: pd.Series[float]) -> list[tuple[object, ...]]:
    middle = float(values.median())
    spread = _TO_SIGMA * float((values - middle).abs().median())
    sigma = (spread**2 + stds**2) ** 0.5
    z = (values - middle) / sigma.where(sigma > 0)
    return [
        (test, name, float(values[test]), float(stds[test]), middle, float(z[test]))
        for test in values.index
        if abs(z[test]) > OUTLYING
    ]
