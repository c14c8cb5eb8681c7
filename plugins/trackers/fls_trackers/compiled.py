"""One way to compile the kernels of this package.

A kernel's machine code on disk is renewed when the kernel's own file changes, but not when only a file
changes whose kernels it calls: after an edit of `events` or `belief`, touch `association`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

__all__ = ["compiled"]

F = TypeVar("F", bound=Callable[..., Any])

log = logging.getLogger(__name__)


def compiled(function: F) -> F:
    """The function in machine code: one thread, without the interpreter's lock, kept on disk where possible.

    No fastmath: equal input gives equal bits.
    """
    try:
        kernel: Any = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError as error:  # neither the package's folder nor the user's cache can be written
        log.info("%s is compiled anew in each process: %s", function.__name__, error)
        kernel = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(F, kernel)
