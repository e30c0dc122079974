"""A series: find the tests, run those that changed, keep one row of each."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ema_pipeline.answers import SERIES_FILE, check_answer_folder
from ema_pipeline.describe import DEFAULT_PIPELINE, checked_rig, rig_text
from ema_pipeline.effects.library import effect_library
from ema_pipeline.errors import EmaError
from ema_pipeline.files import file_hash
from ema_pipeline.ingest.description import DESCRIPTION_FILE
from ema_pipeline.keys import code_fingerprint
from ema_pipeline.processes import peak_memory_mb
from ema_pipeline.results_folder import RESULTS_FILE
from ema_pipeline.run.settings import load_pipeline
from ema_pipeline.series.database import SeriesDatabase
from ema_pipeline.series.engine import Work, in_processes, on_cluster
from ema_pipeline.series.find import FoundTest, find_tests, raw_fingerprint
from ema_pipeline.series.one_test import Task, run_task
from ema_pipeline.series.rows import TestRow
from ema_pipeline.store import Store

TESTS_FOLDER = "tests"
"""Folder of a series that holds the results folders."""

Watch = Callable[[int, int, TestRow], None]
"""Called after each test with the number done, the number to do, and its row."""


@dataclass(frozen=True)
class SeriesRun:
    """What one run of a series did.

    Attributes
    ----------
    folder : Path
    found, computed, skipped, failed, removed : int
        Tests in the tree; run now; unchanged; without results in the end; gone from the tree since the last run.
    seconds : float
        Wall time.
    seconds_per_test : float
        Mean processor time of one test, of those that were run; NaN for none.
    growth : float
        The same of the last tenth of them over that of the first tenth; NaN for fewer than 20, or where the first were
        lost.
    driver_mb, driver_growth_mb : float
        Memory of this process at its largest, and by how much that rose after the first tests.
    """

    folder: Path
    found: int
    computed: int
    skipped: int
    failed: int
    removed: int
    seconds: float
    seconds_per_test: float
    growth: float
    driver_mb: float
    driver_growth_mb: float


def run_series(
    tree: Path,
    out: Path,
    rig: str | None = None,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    pipeline: str | None = None,
    overrides: Sequence[str] = (),
    effect_files: Sequence[str] = (),
    watch: Watch = lambda done, total, row: None,
    work: Work = run_task,
) -> SeriesRun:
    """Run every raw folder under a tree and keep a table of all.

    Parameters
    ----------
    tree, out : Path
        Folder with the tests; folder of the series.
    rig : str, optional
        Name or file of the rig of all tests; what each test names itself where left out.
    jobs : int
        Processes of this machine.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers take the place of `jobs` processes.
    pipeline : str, optional
        Name or file of the pipeline.
    overrides : sequence of str
        ``stage.key=value``.
    effect_files : sequence of str
        Files with the user's own effects; on a cluster all workers must see them under the same paths.
    watch : callable
        Told of every test that is done.
    work : callable
        What is done with one test.

    Raises
    ------
    EmaError
        If the tree holds no tests, or rig, settings, effects or the series' folder are wrong. What is wrong with a
        single test is in its row.
    """
    start = time.perf_counter()
    _check_folder(out)
    made_of = _made_of(rig, pipeline, overrides, effect_files)
    tests = find_tests(tree, out)
    with Store(out).lock():
        database = SeriesDatabase(out)
        try:
            _check_tree(database, tree)
            known = database.keys()
            removed = database.keep_only([t.name for t in tests])
            same = Task(
                "", "", "", made_of, _absolute(rig), _absolute(pipeline), tuple(overrides),
                tuple(str(Path(file).resolve()) for file in effect_files),
            )  # fmt: skip
            described = _tasks(tests, out, same)
            tasks = [t for t in described if not _done(t, known.get(t.name))]
            engine = on_cluster(tasks, scheduler, work) if scheduler else in_processes(tasks, jobs, work)
            costs, memory = _kept(database, engine, len(tasks), watch)
            failed = sum(state != "ok" for _, state in database.keys().values())
        finally:
            database.close()
    tenth = len(costs) // 10
    first = sum(costs[:tenth])
    return SeriesRun(
        out, len(tests), len(costs), len(tests) - len(tasks), failed, removed,
        time.perf_counter() - start,
        sum(costs) / len(costs) if costs else float("nan"),
        sum(costs[-tenth:]) / first if tenth > 1 and first > 0 else float("nan"),
        *memory,
    )  # fmt: skip


def _made_of(
    rig: str | None, pipeline: str | None, overrides: Sequence[str], effect_files: Sequence[str]
) -> str:
    """Fingerprint of all that the tests share; all of it is checked before anything is written."""
    model = None if rig is None else checked_rig(rig)
    if effect_files:
        effect_library(effect_files, model)
    effects = [file_hash(Path(file)) for file in effect_files]
    settings = load_pipeline(pipeline or DEFAULT_PIPELINE, overrides).model_dump_json()
    return json.dumps(
        [code_fingerprint(), rig_text(rig or ""), pipeline, list(overrides), settings, *effects]
    )


def _absolute(name_or_path: str | None) -> str | None:
    """A file's whole path, so that a worker finds it wherever it runs; names are left as they are."""
    if name_or_path is None or not Path(name_or_path).is_file():
        return name_or_path
    return str(Path(name_or_path).resolve())


def _check_folder(out: Path) -> None:
    """A series neither takes the place of another answer nor lies in the raw folder of a test, which it would hide."""
    check_answer_folder(out, SERIES_FILE)
    if (out / DESCRIPTION_FILE).exists():
        raise EmaError(f"{out}: holds the raw data of a test; name another folder with --out")


def _check_tree(database: SeriesDatabase, tree: Path) -> None:
    """One folder holds the series of one tree."""
    before, now = database.about("tree"), str(tree.resolve())
    if before not in ("", now):
        raise EmaError(f"{database.folder}: holds the series of {before}; name another folder with --out")
    database.set_fact("tree", now)


def _tasks(tests: Sequence[FoundTest], out: Path, same: Task) -> Iterator[Task]:
    """A task for each test, from one with what all share."""
    for t in tests:
        key = hashlib.sha256(f"{same.key} {raw_fingerprint(t.raw)}".encode()).hexdigest()
        folder = (out / TESTS_FOLDER / t.name).resolve()
        yield replace(same, name=t.name, raw=str(t.raw.resolve()), out=str(folder), key=key)


def _done(task: Task, known: tuple[str, str] | None) -> bool:
    """True where the row is that of the same raw data, rig, settings and program, and its results are still there."""
    if known is None or known[0] != task.key:
        return False
    return known[1] == "failed" or (Path(task.out) / RESULTS_FILE).exists()


def _kept(
    database: SeriesDatabase, rows: Iterator[TestRow], total: int, watch: Watch
) -> tuple[list[float], tuple[float, float]]:
    """Write rows as they come; the processor time of each, s, and this process's memory, MB."""
    costs: list[float] = []
    settled = 0.0
    for done, row in enumerate(rows, 1):
        database.write(row)
        costs.append(float(row.cost.get("processor_seconds") or 0.0))
        if done <= max(2, total // 10):
            settled = peak_memory_mb()
        watch(done, total, row)
    return costs, (peak_memory_mb(), max(0.0, peak_memory_mb() - settled) if costs else 0.0)
