"""Callbacks from the threads of a library that is not written in Python."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

__all__ = ["Kept"]


class Kept:
    """Keeps Python's state of each foreign thread that calls back, from its first call on.

    Otherwise the interpreter makes that state for each call and drops it afterwards, which costs as much as
    the rest of a callback. Here each such thread has one more `PyGILState_Ensure` than releases: so the C API
    keeps its state until the interpreter ends (Python's C API, "Non-Python created threads").
    """

    def __init__(self) -> None:
        self._local = threading.local()  # as long-lived as that state

    def __call__(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The same callback, for a thread of such a library."""
        local = self._local

        def call(argument: Any) -> None:
            if not hasattr(local, "kept"):
                ctypes.pythonapi.PyGILState_Ensure()
                local.kept = True
            callback(argument)

        return call
