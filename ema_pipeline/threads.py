"""BLAS threads: one per call; parallelism goes over blocks instead.

Several BLAS threads slow the small LAPACK calls of modal analysis by up to two orders of magnitude as
soon as anything else runs on the machine.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def single_blas_thread() -> AbstractContextManager[object]:
    """Context in which BLAS and LAPACK use one thread."""
    return threadpool_limits(limits=1, user_api="blas")
