"""``series.db``: the table of all tests, an SQLite database that is whole after every test."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ema_pipeline.answers import SERIES_FILE
from ema_pipeline.errors import EmaError
from ema_pipeline.series.rows import COLUMNS, Row, TestRow

if TYPE_CHECKING:
    import pandas as pd

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
        self.folder, self.path = folder, folder / SERIES_FILE
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
        if not (folder / SERIES_FILE).is_file():
            raise EmaError(
                f"{folder}: holds no {SERIES_FILE}; make one with 'ema series run TREE --out {folder}'"
            )
        found = cls(folder)
        if not found.about("tree") and not found.keys():
            found.close()
            raise EmaError(
                f"{found.path}: is of a series that was not run; repeat 'ema series run TREE --out {folder}'"
            )
        return found

    def _prepare(self) -> None:
        version = int(self._connection.execute("PRAGMA user_version").fetchone()[0])
        if version not in (0, SCHEMA):
            raise EmaError(
                f"{self.path}: has layout {version}, this version of ema knows {SCHEMA}; delete it"
            )
        self._check_tables(complete=version == SCHEMA)
        if version == SCHEMA:  # reading leaves the file as it is
            return
        with self._connection:
            self._connection.execute("CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT)")
            for table, columns in COLUMNS.items():
                own = ", ".join(f'"{c}" {_type(c)}' for c in columns)
                unique = ", PRIMARY KEY (test)" if table in ("tests", "cost") else ""
                self._connection.execute(f'CREATE TABLE IF NOT EXISTS "{table}" ({own}{unique})')
                self._connection.execute(f'CREATE INDEX IF NOT EXISTS "{table}_test" ON "{table}" (test)')
            self._connection.execute(f"PRAGMA user_version = {SCHEMA}")

    def _check_tables(self, complete: bool) -> None:
        """Make sure that the tables are those of a series; one that is being made may lack some."""
        ours = {"about": {"name", "value"}} | {table: set(columns) for table, columns in COLUMNS.items()}
        named = self._connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        columns = "SELECT name FROM pragma_table_info(?)"
        there = {t: {c for (c,) in self._connection.execute(columns, (t,))} for (t,) in named}
        wanted = ours if complete else there
        for table in sorted({*wanted, *there}):
            if there.get(table) != ours.get(table):
                raise EmaError(
                    f"{self.path}: table '{table}' is not that of a series, or of another version of ema; name "
                    "another folder with --out, or delete the file and run the series again"
                )

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
        """A whole table, by test, configuration and mode where it has these.

        Raises
        ------
        EmaError
            If it cannot be read, or holds text where a number belongs.
        """
        import pandas as pd

        order = [c for c in ("test", "configuration", "mode", "name") if c in COLUMNS[name]]
        by = ", ".join(order)
        with _told(self.path):
            self._check_numbers(name)
            return pd.read_sql_query(f'SELECT * FROM "{name}" ORDER BY {by}, rowid', self._connection)

    def _check_numbers(self, table: str) -> None:
        """Make sure that columns of numbers hold nothing else: SQLite would take anything."""
        for column in COLUMNS[table]:
            text = (
                f'SELECT "{column}" FROM "{table}" WHERE typeof("{column}") IN (\'text\', \'blob\') LIMIT 1'
            )
            if _type(column) != "TEXT" and (found := self._connection.execute(text).fetchone()):
                raise EmaError(
                    f"{self.path}: table '{table}' holds {found[0]!r} in the column '{column}' of numbers; delete the "
                    "file and run the series again"
                )


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
