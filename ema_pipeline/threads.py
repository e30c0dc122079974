"""BLAS threads: one per call; parallelism goes over blocks instead.

Several BLAS threads slow the small LAPACK calls of modal analysis by up to two orders of magnitude as
soon as anything else runs on the machine.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from typing import TypeVar

from threadpoolctl import threadpool_limits

WORTH_A_THREAD = 1 << 16
"""Numbers that a compiled loop goes through in about 0.1 ms; with fewer a second thread costs more than it saves."""


def single_blas_thread() -> AbstractContextManager[object]:
    """Context in which BLAS and LAPACK use one thread."""
    return threadpool_limits(limits=1, user_api="blas")


_sharers = 1
"""Processes among which the processors are shared."""


def cores() -> int:
    """Processors that this process may use."""
    all_ = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, all_ // _sharers)


def share_cores(processes: int) -> None:
    """From here on use only a share of the processors that this process had: so many processes work beside it."""
    global _sharers
    _sharers *= processes


A = TypeVar("A")
R = TypeVar("R")

_at_work: set[int] = set()
"""Threads of pools that work on an item, or wait for threads of their own that do."""


def in_order(work: Callable[[A], R], items: Sequence[A]) -> Iterator[R]:
    """``map(work, items)`` over a thread per processor; what threads call in turn shares what others leave free.

    Worth it where NumPy or compiled loops do the work, which leave the other threads running.
    """
    n = min(_free_cores(), len(items))
    if n < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(n) as pool:
        yield from pool.map(_seen_at_work(work), items)


def _seen_at_work(work: Callable[[A], R]) -> Callable[[A], R]:
    def seen(item: A) -> R:
        me = threading.get_ident()
        _at_work.add(me)
        try:
            return work(item)
        finally:
            _at_work.discard(me)

    return seen


def _free_cores() -> int:
    """Processors for this thread and those that it starts, less one for every other thread that works."""
    return max(1, cores() - len(_at_work - {threading.get_ident()}))


Rows = Callable[[slice], object]
"""Work on some rows that neither reads nor writes what belongs to others."""


@contextmanager
def over_rows(n_rows: int, numbers: int) -> Iterator[Callable[[Rows], None]]:
    """A function that does work on all rows, in a block per processor where that is worth it.

    Results do not depend on how many blocks there are, as long as the work treats every row by itself.

    Parameters
    ----------
    n_rows : int
    numbers : int
        Size of what is worked on.
    """
    n = min(_free_cores(), n_rows, numbers // WORTH_A_THREAD)
    if n < 2:

        def at_once(work: Rows) -> None:
            work(slice(0, n_rows))

        yield at_once
        return
    edges = [n_rows * k // n for k in range(n + 1)]
    with ThreadPoolExecutor(n) as pool:

        def in_blocks(work: Rows) -> None:
            for _ in pool.map(_seen_at_work(work), [slice(a, b) for a, b in pairwise(edges)]):
                pass

        yield in_blocks
