"""Hypotheses over a few processes, in a fixed order, so that the result does not depend on their number."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar, cast

from ema_pipeline.processes import can_fork
from ema_pipeline.threads import cores, single_blas_thread

A = TypeVar("A")
R = TypeVar("R")

_CHUNKS = 12
"""Pieces in which each process gets its share: of many that take milliseconds each, handing over takes as long."""

_job: Callable[..., object] | None = None
_items: Sequence[object] = ()


def spread(job: Callable[[A], R], items: Sequence[A], processes: int | None, least: int = 4) -> Iterator[R]:
    """``map(job, items)`` over forked processes; in this one where the system cannot fork or it is not worth it.

    The job and its items go over by forking, so they may hold what cannot be pickled (effects of a user's own file);
    results are pickled. None stands for a process per processor.

    Parameters
    ----------
    job : callable
    items : sequence
    processes : int or None
    least : int
        Items from which processes are worth it: fewer where each takes seconds.
    """
    processes = processes or cores()
    if processes < 2 or len(items) < least or not can_fork():
        with single_blas_thread():
            for item in items:
                yield job(item)
        return
    global _job, _items
    _job, _items = job, items
    try:
        context = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(min(processes, len(items)), mp_context=context) as pool:
            chunk = max(1, len(items) // (_CHUNKS * processes))
            yield from cast("Iterator[R]", pool.map(_run, range(len(items)), chunksize=chunk))
    finally:
        _job, _items = None, ()


def _run(index: int) -> object:
    assert _job is not None
    with single_blas_thread():
        return _job(_items[index])
