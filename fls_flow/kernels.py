"""One way to compile loops over cells, particles or hypotheses; importing this loads numba.

A kernel's machine code on disk is renewed when the text of its own file changes, but not when only a file
changes whose kernels it calls: after such an edit, delete the caller's `.nbi` and `.nbc` in `__pycache__`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["compiled", "frozen", "prepare"]

F = TypeVar("F", bound=Callable[..., Any])
Scalar = TypeVar("Scalar", bound=np.generic)

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


def frozen(values: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
    """The same values, contiguous and read-only, so that a kernel is compiled once per dtype."""
    view = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view


def prepare() -> None:
    """Load what a process needs before its first kernel; a fork later, all children have it.

    That takes as long as a hundred kernels from the disk.
    """
    _nothing(np.zeros(1))


@compiled
def _nothing(values: npt.NDArray[np.float64]) -> int:
    return values.size
