"""Processes that this one starts: none outlives it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_PR_SET_PDEATHSIG = 1  # linux/prctl.h

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
