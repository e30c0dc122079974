"""The table of a series as CSV and Parquet: one wide row per test, and the long tables."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from ema_pipeline.errors import EmaError
from ema_pipeline.files import refuse_existing, replacing
from ema_pipeline.series.database import SeriesDatabase, rows_of

if TYPE_CHECKING:
    import pandas as pd

LONG_TABLES = ("modes", "parameters", "effects")
_INTERNAL = ["key"]


def wide_table(database: SeriesDatabase) -> pd.DataFrame:
    """One row per test: its facts, then frequency and damping of every mode and every parameter with 1 σ.

    Columns are named ``configuration.mode3.frequency_hz`` and ``parameter.std``; modes have the numbers of their own
    test.
    """
    import pandas as pd

    tests = database.table("tests").drop(columns=_INTERNAL)
    modes, parameters = database.table("modes"), database.table("parameters")
    columns: dict[str, dict[str, float]] = {}
    for row in rows_of(modes):
        for name in ("frequency_hz", "frequency_std_hz", "damping_ratio", "damping_std"):
            column = f"{row.configuration}.mode{row.mode}.{name}"
            columns.setdefault(column, {})[str(row.test)] = getattr(row, name)
    for row in rows_of(parameters):
        columns.setdefault(str(row.name), {})[str(row.test)] = row.value
        columns.setdefault(f"{row.name}.std", {})[str(row.test)] = row.std
    values = pd.DataFrame({name: pd.Series(of, dtype=float) for name, of in columns.items()})
    return tests.merge(values, how="left", left_on="test", right_index=True)


def export_series(
    database: SeriesDatabase, to: Path, parquet: bool = False, *, keep: bool = False
) -> list[Path]:
    """Write the wide table and the long ones into a folder; returns the files.

    Parameters
    ----------
    database : SeriesDatabase
    to : Path
    parquet : bool
        Parquet in place of CSV.
    keep : bool
        Refuse to replace files that exist already.

    Raises
    ------
    EmaError
        If the folder cannot be written, if a file exists already that is to be kept, or if what writes Parquet is not
        installed.
    """
    if parquet and importlib.util.find_spec("pyarrow") is None:
        raise EmaError("--parquet needs pyarrow; install it with: pip install 'ema-pipeline[parquet]'")
    paths = {name: to / f"{name}.{'parquet' if parquet else 'csv'}" for name in ("tests", *LONG_TABLES)}
    if keep:
        refuse_existing(paths.values())
    to.mkdir(parents=True, exist_ok=True)
    for name, path in paths.items():
        table = wide_table(database) if name == "tests" else database.table(name)
        with replacing(path) as scratch:
            if parquet:
                table.to_parquet(scratch, index=False)
            else:
                table.to_csv(scratch, index=False)
    return list(paths.values())
