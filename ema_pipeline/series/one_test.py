"""One test of a series, from its raw folder to its rows; it never raises."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from ema_pipeline.processes import peak_memory_mb
from ema_pipeline.series.rows import Row, TestRow, failed_row


@dataclass(frozen=True)
class Task:
    """What a worker needs to know; plain, so that it goes to another machine.

    Attributes
    ----------
    name, raw, out : str
        Of the test, its raw folder and its results folder.
    key : str
        Fingerprint of raw folder, rig, settings and program.
    rig, pipeline : str or None
    overrides : tuple of str
        ``stage.key=value``.
    effect_files : tuple of str
        Files with the user's own effects, named by whoever runs the series: their code runs.
    """

    name: str
    raw: str
    out: str
    key: str
    rig: str | None = None
    pipeline: str | None = None
    overrides: tuple[str, ...] = ()
    effect_files: tuple[str, ...] = ()


SERIES_SETTINGS = ("processes=1", "diagnose.processes=1")
"""Tests are worked on side by side, so that each has one process; no result depends on it."""


def run_task(task: Task) -> TestRow:
    """Run one test with one BLAS thread; whatever is wrong becomes the row's reason."""
    from ema_pipeline.errors import EmaError
    from ema_pipeline.threads import single_blas_thread

    start, begun = time.perf_counter(), time.process_time()
    try:
        with single_blas_thread():
            row = _run(task)
    except EmaError as error:
        row = failed_row(task.name, task.raw, task.key, str(error))
    except MemoryError:
        row = failed_row(task.name, task.raw, "", "there is not enough memory", "lost")
    except OSError as error:
        row = failed_row(
            task.name, task.raw, "", f"{error.filename or task.out}: {error.strerror or error}", "lost"
        )
    except Exception as error:  # a fault of the program must not stop the other tests
        from ema_pipeline.crash import write_crash_report

        path = write_crash_report(error)
        reason = f"a fault in ema itself ({type(error).__name__}); the details are in {path}"
        row = failed_row(task.name, task.raw, task.key, reason)
    cost: Row = {
        "test": task.name,
        "seconds": time.perf_counter() - start,
        "processor_seconds": time.process_time() - begun,
        "peak_memory_mb": peak_memory_mb(),
    }
    return replace(row, cost=cost)


def _run(task: Task) -> TestRow:
    from ema_pipeline.ingest.campaign import read_campaign
    from ema_pipeline.job import run_raw
    from ema_pipeline.series.rows import row_of
    from ema_pipeline.stages.results import load_results

    raw, out = Path(task.raw), Path(task.out)
    settings = (*SERIES_SETTINGS, *task.overrides)
    run, _ = run_raw(raw, task.rig, out, task.pipeline, settings, effect_files=task.effect_files)
    tests = read_campaign(raw).tests
    about = {
        "serial_number": next((t.serial_number for t in tests if t.serial_number), ""),
        "date": max((t.date for t in tests), default=""),
    }
    return row_of(task.name, task.raw, load_results(run), about, task.key)
