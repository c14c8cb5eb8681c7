"""One BLAS, OpenCV and numba thread: so that bits and load do not depend on the machine."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

__all__ = ["pin_this_thread", "single_threaded"]


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit the process's numerical libraries to one thread each, as far as they are loaded."""
    cv2 = sys.modules.get("cv2")
    before = cv2.getNumThreads() if cv2 is not None else 0
    with threadpool_limits(limits=1):
        if cv2 is not None:
            cv2.setNumThreads(1)
        try:
            yield
        finally:
            if cv2 is not None:
                cv2.setNumThreads(before)


def pin_this_thread() -> None:
    """Limit what counts its threads by calling thread: numba and OpenMP."""
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.set_num_threads(1)
    threadpool_limits(limits=1, user_api="openmp")
