"""Pass, fail or undecided: every value with its own interval held against its limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
import scipy.stats

from ema_pipeline.diagnose.sentences import label_text, probability_text
from ema_pipeline.number_text import format_value, plain
from ema_pipeline.series.acceptance_limits import Limits, Range, reference_modes
from ema_pipeline.series.database import SeriesDatabase, rows_of
from ema_pipeline.series.features import DAMPING, FREQUENCY, MAC, Features, features_of, modes_of_tests

Outcome = Literal["pass", "fail", "undecided"]

CONFIDENCE = 0.95
"""Of the interval of each value, two-sided."""


@dataclass(frozen=True)
class JudgedValue:
    """One value against its limits.

    Attributes
    ----------
    name, unit : str
    value, std : float
        NaN where the test has none.
    limits : Range
    outcome : str
        ``"undecided"`` where the value's interval holds a limit, or where there is no value or no interval.
    """

    name: str
    unit: str
    value: float
    std: float
    limits: Range
    outcome: Outcome

    @property
    def text(self) -> str:
        """Value and limits in words."""
        limits = " and ".join(
            f"{word} {plain(v, 6)}"
            for word, v in (("at least", self.limits.min), ("at most", self.limits.max))
            if v is not None
        )
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        told = "not found" if np.isnan(self.value) else format_value(self.value, self.std, self.unit)
        return f"{self.name} {told}, allowed {limits}{unit}"


@dataclass(frozen=True)
class JudgedTest:
    """One test against all limits.

    Attributes
    ----------
    test : str
    outcome : str
    why : str
        Of a reject the diagnosed effect, else the values that decide; empty for a pass.
    values : tuple of JudgedValue
    """

    test: str
    outcome: Outcome
    why: str
    values: tuple[JudgedValue, ...] = ()


def judged_value(
    name: str, value: float, std: float, limits: Range, unit: str = "", confidence: float = CONFIDENCE
) -> JudgedValue:
    """Hold a value with its two-sided normal interval against limits."""
    half = float(scipy.stats.norm.ppf((1 + confidence) / 2)) * std
    low = -np.inf if limits.min is None else limits.min
    high = np.inf if limits.max is None else limits.max
    outcome: Outcome = "undecided"
    if np.isfinite(value) and np.isfinite(half):
        if low <= value - half and value + half <= high:
            outcome = "pass"
        elif value + half < low or value - half > high:
            outcome = "fail"
    return JudgedValue(name, unit, value, std, limits, outcome)


def judge_series(
    database: SeriesDatabase, limits: Limits, confidence: float = CONFIDENCE
) -> list[JudgedTest]:
    """Every test of a series against limits, in the order of their names.

    A test without results is undecided; a claimed physical effect fails, unless the limits say that it is ignored.
    """
    modes = modes_of_tests(database)
    tests, effects = database.table("tests"), database.table("effects")
    features = features_of(modes, reference_modes(limits), database.table("parameters"))
    several = len({m.configuration for m in limits.modes}) > 1
    judged = []
    for row in rows_of(tests):
        name = str(row.test)
        if row.state != "ok":
            judged.append(JudgedTest(name, "undecided", f"no results: {row.reason}"))
            continue
        values = _values(features, name, limits, several, confidence)
        judged.append(_together(name, values, effects[effects["test"] == name], str(row.verdict), limits))
    return judged


def _values(
    features: Features, test: str, limits: Limits, several: bool, confidence: float
) -> tuple[JudgedValue, ...]:
    out = []
    counts: dict[str, int] = {}
    for m in limits.modes:
        counts[m.configuration] = number = counts.get(m.configuration, 0) + 1
        label = f"{m.configuration + ' ' if several else ''}mode {number}"
        for quantity, words, allowed, unit in (
            (FREQUENCY, "frequency", m.frequency, "Hz"), (DAMPING, "damping", m.damping, ""), (MAC, "MAC", m.mac, ""),
        ):  # fmt: skip
            if allowed is not None:
                value, std = _cell(features, test, f"{label} {words}")
                # A MAC has no interval of its own: what it falls short of is told by the frequencies' scatter.
                std = 0.0 if quantity == MAC else std
                out.append(judged_value(f"{label} {words}", value, std, allowed, unit, confidence))
    for p in limits.parameters:
        value, std = _cell(features, test, p.name)
        unit = str(features.about.loc[p.name, "unit"]) if p.name in features.about.index else ""
        out.append(judged_value(p.name, value, std, p, unit, confidence))
    return tuple(out)


def _cell(features: Features, test: str, name: str) -> tuple[float, float]:
    if test not in features.values.index or name not in features.values.columns:
        return float("nan"), float("nan")
    value, std = features.values.at[test, name], features.stds.at[test, name]
    return float(np.asarray(value, float)), float(np.asarray(std, float))


def _together(
    test: str, values: tuple[JudgedValue, ...], effects: pd.DataFrame, verdict: str, limits: Limits
) -> JudgedTest:
    found = [v for v in values if v.outcome == "fail"]
    open_ = [v for v in values if v.outcome == "undecided"]
    named = effects_text(effects)
    reasons = [v.text for v in found] or [v.text for v in open_]
    if found or (named and limits.effects == "fail"):
        return JudgedTest(
            test, "fail", "; ".join([*([named] if named else []), *(v.text for v in found)]), values
        )
    if limits.effects == "fail" and verdict == "unknown_effect":
        reasons.insert(0, "the model does not explain the data, and no effect of the library does")
    return JudgedTest(test, "undecided" if reasons else "pass", "; ".join(reasons), values)


def effects_text(effects: pd.DataFrame) -> str:
    """Claimed effects of one test with their sizes; empty for none."""
    told = []
    for (effect, at), sizes in effects.groupby(["effect", "at"], sort=False):
        listed = ", ".join(f"{s.name} {format_value(s.value, s.std, s.unit)}" for s in rows_of(sizes))
        odds = probability_text(float(sizes["probability"].iloc[0]))
        told.append(f"{label_text(f'{effect}@{at}')}, {listed} (probability {odds})")
    return "; ".join(told)
