"""What is compared from test to test: frequencies, damping ratios and shapes of matched modes, and parameters."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from ema_pipeline.correlate.matching import mac_between, match_modes
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.dof import Dof
from ema_pipeline.errors import EmaError
from ema_pipeline.series.database import SeriesDatabase, rows_of

FREQUENCY, DAMPING, MAC, PARAMETER = "frequency", "damping", "mac", "parameter"
UNITS = {FREQUENCY: "Hz", DAMPING: "1", MAC: "1"}

TestModes = dict[str, MeasuredModes]
"""Modes of one test by configuration."""


@dataclass(frozen=True)
class Features:
    """A table of values with their standard deviations.

    Attributes
    ----------
    values, stds : DataFrame
        Tests by features; NaN where a test has none, or no standard deviation.
    about : DataFrame
        By feature: configuration, mode (from 1, of the reference), quantity, unit.
    """

    values: pd.DataFrame
    stds: pd.DataFrame
    about: pd.DataFrame


def modes_of_tests(database: SeriesDatabase) -> dict[str, TestModes]:
    """Measured modes of all tests that have some, by test and configuration.

    Raises
    ------
    EmaError
        If the table of modes is damaged.
    """
    found: dict[str, TestModes] = {}
    for (test, configuration), rows in database.table("modes").groupby(["test", "configuration"], sort=True):
        try:
            modes = _measured(str(configuration), rows)
        except (ValueError, TypeError, KeyError, IndexError, EmaError):
            raise EmaError(
                f"{database.path}: the modes of test '{test}' are damaged; delete the file and run the series again"
            ) from None
        found.setdefault(str(test), {})[str(configuration)] = modes
    return found


def _measured(configuration: str, rows: pd.DataFrame) -> MeasuredModes:
    shapes = [json.loads(text) for text in rows["shape"]]
    names = list(dict.fromkeys(d for s in shapes for d in s["dofs"]))
    array = np.full((len(rows), len(names)), np.nan, complex)
    for r, s in enumerate(shapes):
        array[r, [names.index(d) for d in s["dofs"]]] = np.array(s["re"]) + 1j * np.array(s["im"])
    frequency, frequency_std, damping, damping_std = (
        rows[k].to_numpy(float) for k in ("frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std")
    )
    return MeasuredModes(
        configuration, frequency, frequency_std, damping, damping_std,
        shapes=array if names else None, dofs=tuple(Dof.parse(n) for n in names),
    )  # fmt: skip


def reference_of(database: SeriesDatabase, modes: Mapping[str, TestModes], wanted: str | None = None) -> str:
    """The test whose modes number those of all: `wanted`, or the first one that is like most.

    Like most: with the commonest number of modes, and found adequate where tests were diagnosed.

    Raises
    ------
    EmaError
        If no test has modes, or not the one that is wanted.
    """
    if wanted is not None:
        if wanted not in modes:
            raise EmaError(
                f"{database.folder}: test '{wanted}' has no modes; see 'tests.csv' for those that have"
            )
        return wanted
    if not modes:
        raise EmaError(f"{database.folder}: no test has modes; 'ema series run' says why")
    tests = database.table("tests").set_index("test")
    names = [t for t in modes if tests.loc[t, "verdict"] == "adequate"] or list(modes)
    counts = {t: tuple(len(m) for m in modes[t].values()) for t in names}
    commonest = Counter(counts.values()).most_common(1)[0][0]
    return next(t for t in names if counts[t] == commonest)


def features_of(
    modes: Mapping[str, TestModes],
    reference: Mapping[str, MeasuredModes],
    parameters: pd.DataFrame | None = None,
) -> Features:
    """Values of all tests, their modes matched with those of a reference.

    Parameters
    ----------
    modes : dict of str to dict
        See `modes_of_tests`.
    reference : dict of str to MeasuredModes
        By configuration.
    parameters : DataFrame, optional
        Table ``parameters`` of the database.
    """
    rows = [row for test, own in modes.items() for row in _mode_rows(test, own, reference)]
    if parameters is not None:
        rows += [
            (p.test, str(p.name), PARAMETER, "", 0, str(p.unit), p.value, p.std)
            for p in rows_of(parameters)
            if p.identified
        ]
    columns = ["test", "feature", "quantity", "configuration", "mode", "unit", "value", "std"]
    table = pd.DataFrame(rows, columns=columns)
    about = table.drop(columns=["test", "value", "std"]).drop_duplicates("feature").set_index("feature")

    def wide(what: str) -> pd.DataFrame:
        made = table.pivot(index="test", columns="feature", values=what)
        return made.reindex(index=list(modes), columns=list(about.index)).astype(float)

    return Features(wide("value"), wide("std"), about)


def _mode_rows(test: str, own: TestModes, reference: Mapping[str, MeasuredModes]) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    several = len(reference) > 1
    for configuration, expected in reference.items():
        found = own.get(configuration)
        if found is None:
            continue
        match, alike = match_modes(expected, found), mac_between(expected, found)
        for k, at in enumerate(match):
            if at < 0:
                continue
            label = f"{configuration + ' ' if several else ''}mode {k + 1}"
            place = (configuration, k + 1)
            rows.append(
                (
                    test,
                    f"{label} frequency",
                    FREQUENCY,
                    *place,
                    "Hz",
                    found.frequency_hz[at],
                    found.frequency_std_hz[at],
                )
            )
            rows.append(
                (
                    test,
                    f"{label} damping",
                    DAMPING,
                    *place,
                    "1",
                    found.damping_ratio[at],
                    found.damping_std[at],
                )
            )
            if alike is not None:
                rows.append((test, f"{label} MAC", MAC, *place, "1", float(alike[k, at]), np.nan))
    return rows


def features_of_series(database: SeriesDatabase, reference: str | None = None) -> tuple[Features, str]:
    """The features of a whole series, and the test that numbers its modes."""
    modes = modes_of_tests(database)
    named = reference_of(database, modes, reference)
    return features_of(modes, modes[named], database.table("parameters")), named
