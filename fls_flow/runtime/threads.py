"""A fixed number of BLAS, OpenCV and numba threads: so that bits and load do not depend on the machine."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

__all__ = ["limit_this_thread", "limited_threads"]


@contextmanager
def limited_threads(threads: int = 1) -> Iterator[None]:
    """Limit the process's numerical libraries to so many threads each, as far as they are loaded."""
    cv2 = sys.modules.get("cv2")
    before = cv2.getNumThreads() if cv2 is not None else 0
    with threadpool_limits(limits=threads):
        if cv2 is not None:
            cv2.setNumThreads(threads)
        try:
            yield
        finally:
            if cv2 is not None:
                cv2.setNumThreads(before)


def limit_this_thread(threads: int = 1) -> None:
    """Limit what counts its threads by calling thread: numba, as far as it has so many, and OpenMP."""
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    threadpool_limits(limits=threads, user_api="openmp")
