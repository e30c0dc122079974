"""Tests over processes of this machine, or over the workers of a Dask cluster.

Both hand back rows as they are done, and hold only as many tests at a time as keep the workers busy, so that the memory
of this process does not grow with the series.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any

from ema_pipeline.errors import EmaError
from ema_pipeline.processes import workers_die_with_us
from ema_pipeline.series.one_test import Task, run_task
from ema_pipeline.series.rows import TestRow, failed_row

Work = Callable[[Task], TestRow]

_TESTS_PER_WORKER = 100
"""A process is replaced after so many tests: what libraries keep in memory does not add up."""
_PER_THREAD = 2
"""Tests that the cluster holds for each thread of its workers, so that none waits for this process."""
_RETRIES = 2
_ANSWERS_S = 10.0
"""Time that a scheduler is given to answer."""
LOST = "its process ended without a result, usually for lack of memory; run the series again with fewer jobs"


def in_processes(tasks: Iterable[Task], jobs: int, work: Work = run_task) -> Iterator[TestRow]:
    """Rows of all tasks, as they are done; a task that kills its process is a row as well.

    Parameters
    ----------
    tasks : iterable of Task
    jobs : int
        Processes.
    work : callable
        What is done with a task.
    """
    left = iter(tasks)
    with workers_die_with_us():
        while True:
            batch = list(islice(left, jobs * _TESTS_PER_WORKER))
            if not batch:
                return
            suspects = yield from _through_pool(batch, jobs, work)
            for task in suspects:  # alone, so that what kills a process takes no other test with it
                if (yield from _through_pool([task], 1, work)):
                    yield failed_row(task.name, task.raw, "", LOST, "lost")


def _through_pool(batch: list[Task], jobs: int, work: Work) -> Generator[TestRow, None, list[Task]]:
    """Rows of a batch; returns the tasks that a broken pool has not answered."""
    unanswered = {task.name: task for task in batch}
    context = multiprocessing.get_context("fork" if hasattr(os, "fork") else "spawn")
    try:
        with ProcessPoolExecutor(min(jobs, len(batch)), mp_context=context) as pool:
            for row in _window(pool.submit, batch, 2 * jobs, work):
                del unanswered[row.name]
                yield row
    except BrokenProcessPool:
        pass
    return list(unanswered.values())


def _window(
    submit: Callable[..., Future[TestRow]], batch: list[Task], size: int, work: Work
) -> Iterator[TestRow]:
    """Rows of a batch of which `size` tasks are under way at a time."""
    tasks = iter(batch)
    running = {submit(work, task) for task in islice(tasks, size)}
    while running:
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()
            running |= {submit(work, task) for task in islice(tasks, 1)}


def on_cluster(tasks: Iterable[Task], address: str, work: Work = run_task) -> Iterator[TestRow]:
    """Rows of all tasks from the workers of a Dask cluster, as they are done.

    The scheduler gives the tests of a lost worker to others. Raw folders and results must lie where all workers see
    them under the same paths.

    Parameters
    ----------
    tasks : iterable of Task
    address : str
        Of the scheduler, e.g. ``tcp://10.0.0.1:8786``.
    work : callable

    Raises
    ------
    EmaError
        If Dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
        from distributed.comm.addressing import get_address_host_port
    except ImportError:
        raise EmaError(
            "--scheduler needs Dask; install it with: pip install 'ema-pipeline[dask]', or use --jobs"
        ) from None
    try:
        # Asked first by a bare connection: a client without a scheduler takes its time to give up, and says so twice.
        with socket.create_connection(get_address_host_port(address), timeout=_ANSWERS_S):
            pass
        client = Client(address, timeout=_ANSWERS_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise EmaError(f"--scheduler {address}: no Dask scheduler answers there ({error})") from None
    with client:
        source = iter(tasks)
        asked: dict[str, Task] = {}

        def submit(count: int) -> list[Any]:
            futures = []
            for task in islice(source, max(count, 0)):
                future = client.submit(work, task, pure=False, retries=_RETRIES)
                asked[str(future.key)] = task
                futures.append(future)
            return futures

        running = as_completed(submit(1), loop=client.loop)
        for future in running:
            task = asked.pop(str(future.key))
            if future.status == "finished":
                yield future.result()
            else:
                yield failed_row(task.name, task.raw, "", _lost_on_cluster(future), "lost")
            future.release()
            wanted = max(1, _PER_THREAD * sum(client.nthreads().values()))  # workers come and go
            for new in submit(wanted - running.count()):
                running.add(new)


def _lost_on_cluster(future: Any) -> str:
    error = future.exception()
    return f"lost on the cluster ({type(error).__name__}); run the series again"
