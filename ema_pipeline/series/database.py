"""``series.db``: the table of all tests, an SQLite database that is whole after every test."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ema_pipeline.errors import EmaError
from ema_pipeline.series.rows import COLUMNS, Row, TestRow

if TYPE_CHECKING:
    import pandas as pd

DATABASE = "series.db"
SCHEMA = 1

_TEXT = frozenset(
    [
        "test",
        "raw",
        "results",
        "key",
        "state",
        "reason",
        "serial_number",
        "date",
        "title",
        "rig",
        "verdict",
        "summary",
        "effects",
        "warnings",
        "configuration",
        "shape",
        "name",
        "unit",
        "effect",
        "at",
    ]
)
_WHOLE = frozenset({"hits_used", "hits_rejected", "modes", "mode", "model_mode", "identified"})


class SeriesDatabase:
    """The database of one series.

    Parameters
    ----------
    folder : Path
        Folder of the series.

    Raises
    ------
    EmaError
        If the database cannot be opened, or is of another version.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / DATABASE
        with _told(self.path):
            self._connection = sqlite3.connect(self.path)
            # SQLite's journal undoes a half-written test; write-ahead logs do not work on network shares.
            self._connection.execute("PRAGMA journal_mode=DELETE")
            self._prepare()

    @classmethod
    def existing(cls, folder: Path) -> SeriesDatabase:
        """The database of a series that was run.

        Raises
        ------
        EmaError
            If the folder holds none.
        """
        if not (folder / DATABASE).is_file():
            raise EmaError(
                f"{folder}: holds no {DATABASE}; make one with 'ema series run TREE --out {folder}'"
            )
        return cls(folder)

    def _prepare(self) -> None:
        version = int(self._connection.execute("PRAGMA user_version").fetchone()[0])
        if version not in (0, SCHEMA):
            raise EmaError(
                f"{self.path}: has layout {version}, this version of ema knows {SCHEMA}; delete it"
            )
        with self._connection:
            self._connection.execute("CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT)")
            for table, columns in COLUMNS.items():
                own = ", ".join(f'"{c}" {_type(c)}' for c in columns)
                unique = ", PRIMARY KEY (test)" if table in ("tests", "cost") else ""
                self._connection.execute(f'CREATE TABLE IF NOT EXISTS "{table}" ({own}{unique})')
                self._connection.execute(f'CREATE INDEX IF NOT EXISTS "{table}_test" ON "{table}" (test)')
            self._connection.execute(f"PRAGMA user_version = {SCHEMA}")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def about(self, name: str) -> str:
        """A fact about the series; empty where it is not known."""
        found = self._connection.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
        return "" if found is None else str(found[0])

    def set_fact(self, name: str, value: str) -> None:
        """Keep a fact about the series."""
        with _told(self.path), self._connection:
            self._connection.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (name, value))

    def write(self, row: TestRow) -> None:
        """Put one test in, in place of its earlier rows, in one transaction.

        Raises
        ------
        EmaError
            If the file cannot be written.
        """
        with _told(self.path), self._connection:
            self._delete(row.name)
            self._insert("tests", [row.test])
            for table in ("modes", "parameters", "effects"):
                self._insert(table, getattr(row, table))
            if row.cost:
                self._insert("cost", [row.cost])

    def _delete(self, test: str) -> None:
        for table in COLUMNS:
            self._connection.execute(f'DELETE FROM "{table}" WHERE test = ?', (test,))

    def _insert(self, table: str, rows: Iterable[Row]) -> None:
        columns = COLUMNS[table]
        places = ", ".join("?" * len(columns))
        self._connection.executemany(
            f'INSERT INTO "{table}" VALUES ({places})', [tuple(row.get(c) for c in columns) for row in rows]
        )

    def keep_only(self, names: Iterable[str]) -> int:
        """Take out all tests but these; returns how many were taken out."""
        gone = set(self.keys()) - set(names)
        with _told(self.path), self._connection:
            for name in gone:
                self._delete(name)
        return len(gone)

    def keys(self) -> dict[str, tuple[str, str]]:
        """Fingerprint and state of every test by its name."""
        found = self._connection.execute("SELECT test, key, state FROM tests")
        return {str(name): (key or "", state) for name, key, state in found}

    def table(self, name: str) -> pd.DataFrame:
        """A whole table, by test, configuration and mode where it has these."""
        import pandas as pd

        order = [c for c in ("test", "configuration", "mode", "name") if c in COLUMNS[name]]
        by = ", ".join(order)
        return pd.read_sql_query(f'SELECT * FROM "{name}" ORDER BY {by}, rowid', self._connection)


def rows_of(table: pd.DataFrame) -> Iterable[Any]:
    """Rows with the columns as attributes."""
    return table.itertuples(index=False)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Errors of SQLite in one line."""
    try:
        yield
    except sqlite3.Error as error:
        raise EmaError(
            f"{path}: {error}; is it the database of a series, is the disk full, or is another process writing to it?"
        ) from None


def _type(column: str) -> str:
    return "TEXT" if column in _TEXT else "INTEGER" if column in _WHOLE else "REAL"
