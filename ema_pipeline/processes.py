"""Processes that this one starts: none outlives it."""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ema_pipeline.threads import cores, share_cores, single_blas_thread

if TYPE_CHECKING:
    from multiprocessing.context import ForkProcess

A = TypeVar("A")
R = TypeVar("R")

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h

_holders = 0
"""Blocks of `workers_die_with_us` that are open; forked processes inherit the number."""


@contextmanager
def workers_die_with_us() -> Iterator[None]:
    """While the block is open, every process forked from this one is killed when this one ends, however it ends.

    A run that is killed must not leave workers behind that go on computing for nobody.
    """
    global _holders
    _install()
    _holders += 1
    try:
        yield
    finally:
        _holders -= 1


def peak_memory_mb() -> float:
    """Largest memory that this process has had so far, MB; NaN where the system does not tell."""
    try:
        import resource
    except ImportError:  # not on Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def release_memory() -> None:
    """Give memory that is free back to the system, which the C library otherwise keeps in pieces (Linux)."""
    if sys.platform == "linux":
        with suppress(AttributeError):  # not with every C library
            ctypes.CDLL(None).malloc_trim(0)


def one_store_of_memory() -> None:
    """Have the threads that this process will start take their memory from one store (Linux).

    With a store each, as the C library has it, what one thread has freed is lost to the others. Arrays from 4 MB on are
    kept apart and given back at once; with the C library's own limit, which rises to 32 MB, they leave holes. What is
    smaller is not given back each time that the store's end is free.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):
            library = ctypes.CDLL(None)
            library.mallopt(_M_ARENA_MAX, 1)
            library.mallopt(_M_MMAP_THRESHOLD, 4 << 20)
            library.mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def die_with_parent(parent: int) -> None:
    """Have the system kill this process as soon as the process `parent`, which started it, is gone.

    Only Linux can do that; elsewhere nothing happens.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it went before we could ask
        os._exit(1)


_parent = 0
_installed = False


def _install() -> None:
    global _installed
    if _installed or not hasattr(os, "register_at_fork"):
        return
    os.register_at_fork(before=_remember_parent, after_in_child=_in_child)
    _installed = True


def _remember_parent() -> None:
    global _parent
    _parent = os.getpid()


def _in_child() -> None:
    if _holders:
        die_with_parent(_parent)


def can_fork() -> bool:
    """True where this process may share its work with copies of itself."""
    return sys.platform == "linux" and not multiprocessing.current_process().daemon


_CHUNKS = 12
"""Pieces in which each process gets its share: of many that take milliseconds each, handing over takes as long."""

_job: Callable[..., object] | None = None
_items: Sequence[object] = ()


def spread(job: Callable[[A], R], items: Sequence[A], processes: int | None, least: int = 4) -> Iterator[R]:
    """``map(job, items)`` over forked processes; in this one where the system cannot fork or it is not worth it.

    Results come in the order of the items, so that they do not depend on the number of processes. The job and its items
    go over by forking, so they may hold what cannot be pickled (effects of a user's own file); results are pickled.
    Each process has its share of the processors for what it does within.

    Parameters
    ----------
    job : callable
    items : sequence
    processes : int or None
        None stands for a process per processor.
    least : int
        Items from which processes are worth it: fewer where each takes seconds.

    Raises
    ------
    MemoryError
        If a process was killed, for want of memory most likely.
    """
    processes = min(processes or cores(), len(items))
    if processes < 2 or len(items) < least or not can_fork():
        with single_blas_thread():
            for item in items:
                yield job(item)
        return
    global _job, _items
    _job, _items = job, items
    context = multiprocessing.get_context("fork")
    chunk = max(1, len(items) // (_CHUNKS * processes))
    try:
        with ProcessPoolExecutor(processes, context, share_cores, (processes,)) as pool:
            yield from cast("Iterator[R]", pool.map(_run, range(len(items)), chunksize=chunk))
    except BrokenProcessPool:
        raise MemoryError("a worker process ended unexpectedly") from None
    finally:
        _job, _items = None, ()


def _run(index: int) -> object:
    assert _job is not None
    with single_blas_thread():
        return _job(_items[index])


@contextmanager
def aside(job: Callable[[], R], processes: int | None = None) -> Iterator[Callable[[], R]]:
    """Do a job in a forked process while the block goes on; what is given waits for what it returns.

    It is done where that is asked for, in this process, where the system cannot fork or there is one process only. The
    job goes over by forking, what it returns is pickled. What is not asked for is broken off at the end of the block.

    Parameters
    ----------
    job : callable
    processes : int or None
        All that may work, this one among them; None stands for a process per processor.
    """
    if (processes or cores()) < 2 or not can_fork():
        yield job
        return
    mine, process = _begun(lambda _, send: send(job()), None)

    def result() -> R:
        kind, content = _received(mine)
        if kind == "failed":
            raise content
        return cast("R", content)

    try:
        yield result
    finally:
        process.kill()
        process.join()
        mine.close()


Send = Callable[[Any], None]


def side_by_side(
    job: Callable[[Any, Send], None], items: Sequence[Any], processes: int, hear: Callable[[Any], None]
) -> None:
    """Do a job for every item in a forked process each, a few at a time.

    Parameters
    ----------
    job : callable
        Takes an item and a function that sends what can be pickled to `hear`. It goes over by forking, so that it may
        hold what cannot be pickled.
    items : sequence
    processes : int
        Most that run at a time.
    hear : callable
        Is called in this process, with what a job sends.

    Raises
    ------
    Exception
        What the first of the items that failed raised; the others are done to the end.
    """
    left = list(enumerate(items))
    running: dict[Connection, tuple[int, ForkProcess]] = {}
    failed: dict[int, Exception] = {}
    gc.freeze()  # what is there is shared by all: a worker that looks for cycles in it would copy it
    try:
        while left or running:
            while left and len(running) < processes:
                index, item = left.pop(0)
                mine, process = _begun(job, item)
                running[mine] = (index, process)
            ready = wait(list(running))
            for connection, (index, process) in list(running.items()):
                if connection not in ready:
                    continue
                kind, content = _received(connection, f" ({items[index]})")
                if kind == "told":
                    hear(content)
                    continue
                if kind == "failed":
                    failed[index] = content
                process.join()
                del running[connection]
    finally:
        gc.unfreeze()
        for _, process in running.values():
            process.kill()
            process.join()
    if failed:
        raise failed[min(failed)]


def _begun(job: Callable[[Any, Send], None], item: Any) -> tuple[Connection, ForkProcess]:
    """A forked process that does a job for one item, and where it is heard."""
    context = multiprocessing.get_context("fork")
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_do, args=(job, item, theirs))
    with workers_die_with_us():
        process.start()
    theirs.close()
    return mine, process


def _received(connection: Connection, what: str = "") -> tuple[str, Any]:
    """What a process says: "told", "done" or "failed", and with what; it fails where it ended without a word."""
    try:
        kind, content = connection.recv()
    except EOFError:  # killed, for want of memory most likely
        return "failed", MemoryError(f"a worker process ended unexpectedly{what}")
    return kind, content


def _do(job: Callable[[Any, Send], None], item: Any, to: Connection) -> None:
    try:
        job(item, lambda content: to.send(("told", content)))
        to.send(("done", None))
    except Exception as error:
        error.add_note("In a worker:\n" + traceback.format_exc())  # for the crash report
        to.send(("failed", error))
